"""What a search needs to know of one field, computed once: the places of its words, and its answers about its own classes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from .._card import short_repr
from .._origin import Origin, to_local
from ..cameras import Camera
from ..fields import SemanticField
from ..gaussians import Gaussians
from ..labels import LabelSet, connected_parts
from ..labels.components import MOST_SPACINGS, NEIGHBOUR, QUANTILE, SPACINGS, radius_components
from ..labels.parts import Part, gaussian_shares
from ..labels.selection import Selection
from .search_file import VIEWS, Array, Rows, empty_rows
from .shared_codebook import SharedCodebook

SMALLEST = 5  # Gaussians of an atom with a place of its own; on room_0 such atoms hold 93 % of the Gaussians
NEIGHBOURS = 12  # nearest Gaussians that are looked at for links between atoms
MOST_CLASSES = 256  # of a table whose answers are kept: each is a query of the field


class Described(NamedTuple):
    """The rows of a field for the index (`search_file.COLUMNS`), and the codebook with its words."""

    rows: dict[str, Rows]
    book: SharedCodebook
    outside: float  # share of the known Gaussians whose word is farther than the tolerance

    def __repr__(self) -> str:
        return short_repr(self)


class Grouped(NamedTuple):
    """Gaussians in disjoint groups, by number."""

    group: Array  # [N] int64, -1 = in none
    word: Array  # [A] int64
    pooled: Array  # [A] bool
    links: Array  # [L, 2] int32, pairs of groups that touch

    def __repr__(self) -> str:
        return short_repr(self)


def describe(field: SemanticField, book: SharedCodebook, classes: LabelSet | None) -> Described:
    """Describe a field in words; the codebook gets new ones where it has none for its features.

    Atoms are the connected parts of the Gaussians of one word. Those with fewer than 5 Gaussians are pooled: one row for
    each word, without links. Each class is answered by `field.query` and `connected_parts` with their defaults.
    """
    known = field.known
    word, outside = np.full(len(field), -1, np.int64), 0.0
    if bool(known.any()):
        own = field.features if field.answers is None else field.answers
        features = own[known] if field.linear is not None else field.own_features(known.nonzero()[:, 0])
        book = book.extended(features, field.linear)
        near = book.nearest(features, field.linear)
        word[known.cpu().numpy()] = near.codeword.cpu().numpy()
        outside = float((near.similarity < book.tolerance).double().mean())
    asked = () if classes is None or len(classes) > MOST_CLASSES else classes.names
    selections = [field.query(name, classes) for name in asked]
    parts = [(label, part) for label, one in enumerate(selections) for part in connected_parts(field.gaussians, one)]
    atoms = _atoms(field.gaussians, word)
    in_atoms, in_parts = _shares(
        field.gaussians, field.cameras, atoms, [part.indices.cpu().numpy() for _, part in parts]
    )
    rows: dict[str, Rows] = {
        "atoms": _atom_rows(field.gaussians.means.detach().cpu().double().numpy(), atoms, in_atoms),
        "links": {"pair": atoms.links},
        "classes": {
            "count": np.array([len(one) for one in selections], np.int32),
            "score": np.array([_mean_score(one) for one in selections], np.float32),
        },
        "parts": _part_rows(parts, in_parts, field.gaussians.origin),
    }
    return Described(rows, book, outside)


def _atoms(gaussians: Gaussians, word: Array) -> Grouped:
    """Connected parts of the Gaussians of each word, the largest first, then what is pooled."""
    inside = np.flatnonzero(word >= 0)
    group = np.full(len(word), -1, np.int64)
    if not len(inside):
        return Grouped(group, group[:0], group[:0] > 0, np.zeros((0, 2), np.int32))
    points, words = gaussians.means.detach().cpu().double().numpy()[inside], word[inside]
    found = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))
    near, index = (np.reshape(one, (len(points), -1)) for one in found)
    reach = _reach(near[:, min(NEIGHBOUR, near.shape[1] - 1)], words)
    part = radius_components(
        np.column_stack([points / reach[:, None], 2.0 * words]), 1.0
    )  # words lie apart on a 4th axis
    large = int((np.bincount(part) >= SMALLEST).sum())
    small, pool = np.unique(words[part >= large], return_inverse=True)
    part[part >= large] = large + pool
    own, other = part[:, None], part[index]
    touch = (own < other) & (other < large) & (near <= (reach[:, None] + reach[index]) / 2)
    links = np.unique(np.column_stack([np.broadcast_to(own, other.shape)[touch], other[touch]]), axis=0)
    first = np.unique(part, return_index=True)[1]
    group[inside] = part
    return Grouped(group, words[first], np.arange(large + len(small)) >= large, links.astype(np.int32))


def _reach(spacing: Array, words: Array) -> Array:  # [n], [n] -> [n]
    """How far the Gaussians of each word are connected: `labels.components.component_distance`, with spacings in the cloud."""
    order = np.lexsort((spacing, words))
    first, count = np.unique(words[order], return_index=True, return_counts=True)[1:]
    most = MOST_SPACINGS * float(np.quantile(spacing, QUANTILE)) or 1.0
    quantile = spacing[order][first + np.floor(QUANTILE * (count - 1)).astype(np.int64)]
    reach = np.clip(SPACINGS * quantile, 1e-6 * most, most)
    return np.asarray(reach[np.unique(words, return_inverse=True)[1]])


def _shares(
    gaussians: Gaussians, cameras: Sequence[Camera], atoms: Grouped, parts: list[Array]
) -> tuple[Array, Array]:  # [C, A], [C, P]
    """The share of each camera's picture that each atom and each part fills (`labels.parts.view_shares`, in one pass)."""
    inside = atoms.group >= 0
    members = np.concatenate([np.zeros(0, np.int64), *parts])
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    found = np.zeros((len(cameras), len(atoms.word))), np.zeros((len(cameras), len(parts)))
    for c, camera in enumerate(cameras):
        share = gaussian_shares(gaussians, camera).double().cpu().numpy()
        found[0][c] = np.bincount(atoms.group[inside], share[inside], minlength=len(atoms.word))
        found[1][c] = np.bincount(owner, share[members], minlength=len(parts))
    return found


def _atom_rows(points: Array, atoms: Grouped, shares: Array) -> Rows:  # [N, 3], [C, A]
    order = np.argsort(atoms.group, kind="stable")[int((atoms.group < 0).sum()) :]
    count = np.bincount(atoms.group[order], minlength=len(atoms.word))
    if not len(count):
        return empty_rows("atoms")
    start = np.cumsum([0, *count[:-1]])
    views = np.full((len(count), VIEWS), -1, np.int32)
    best = np.argsort(-shares, axis=0, kind="stable")[:VIEWS].T  # [A, up to VIEWS]
    kept = np.zeros((len(count), VIEWS), np.float32)
    kept[:, : best.shape[1]] = np.take_along_axis(shares.T, best, axis=1)
    views[:, : best.shape[1]] = best
    return {
        "word": atoms.word.astype(np.int32),
        "count": count.astype(np.int32),
        "pooled": atoms.pooled.astype(np.uint8),
        "center": (np.add.reduceat(points[order], start) / count[:, None]).astype(np.float32),
        "low": np.minimum.reduceat(points[order], start).astype(np.float32),
        "high": np.maximum.reduceat(points[order], start).astype(np.float32),
        "views": np.where(kept > 0, views, -1),
        "shares": kept,
    }


def _part_rows(parts: list[tuple[int, Part]], shares: Array, origin: Origin) -> Rows:  # [C, P]
    if not parts:
        return empty_rows("parts")
    best = shares.argmax(axis=0) if len(shares) else np.full(len(parts), -1)
    share = shares.max(axis=0, initial=0.0)
    return {
        "label": np.array([label for label, _ in parts], np.int32),
        "count": np.array([part.count for _, part in parts], np.int32),
        "score": np.array([part.score for _, part in parts], np.float32),
        "center": to_local(torch.stack([part.centroid for _, part in parts]), origin).cpu().numpy(),
        "low": to_local(torch.stack([part.extent[0] for _, part in parts]), origin).cpu().numpy(),
        "high": to_local(torch.stack([part.extent[1] for _, part in parts]), origin).cpu().numpy(),
        "view": np.where(share > 0, best, -1).astype(np.int32),
        "share": share.astype(np.float32),
    }


def _mean_score(selection: Selection) -> float:
    return float(selection.scores[selection.mask].double().mean()) if len(selection) else 0.0
