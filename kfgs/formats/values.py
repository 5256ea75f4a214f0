"""Helpers of all formats: values that are mended or refused, flipped axes, and descriptions of what a format cannot store."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import most_unpacked
from .._check import as_origin
from .._notes import tell
from ..gaussians import Gaussians

SCORE = "score"  # the column with `Gaussians.scores`
SH_C0 = 0.28209479177387814  # the constant harmonic: rgb = 0.5 + SH_C0 * coefficient
UP_AND_BACK = (1, -1, -1)  # x right, y up, z back (RUB) against x right, y down, z forward (RDF) of the 3DGS PLY
# Signs of the coefficients under a flip of axes: which of x, y, z each harmonic is odd in, degrees 1 to 3.
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
_TINY_SCALE = 1e-10  # world units, instead of a scale of 0
_SHORTEST = 1e-12  # of a quaternion; kornia divides by no less
_SHOWN = 5  # rows that a note names
_UNKNOWN = torch.iinfo(torch.int64).min  # a label that is no number
EXACT = 1 << 24  # float32 holds all whole numbers up to this one
_LABELS = 2**31 - 1  # the largest int32
_RULES: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "means": ("finite numbers", Tensor.isfinite),
    "quats": ("finite numbers, not all 0", lambda q: q.isfinite() & (q.norm(dim=1, keepdim=True) > _SHORTEST)),
    "scales": ("finite numbers above 0", lambda s: s.isfinite() & (s > 0)),
    "opacities": ("numbers from 0 to 1", lambda o: (o >= 0) & (o <= 1)),
    "sh": ("finite numbers", Tensor.isfinite),
    "features": ("finite numbers", Tensor.isfinite),
    "scores": ("finite numbers", Tensor.isfinite),
}
"""What values have to be when they are written, in words and as a mask. All but scores make Gaussians that cannot be drawn."""
_RAW = {
    "scales": "if they are logarithms, as 3DGS trains them, take scales.exp()",
    "opacities": "if they are logits, as 3DGS trains them, take opacities.sigmoid()",
}
"""What to do if most values are out of range."""


def check_count(count: int, degree: int, packed: int) -> None:
    """Raise a ValueError if a compressed file of `packed` bytes promises more Gaussians than `most_unpacked` allows.

    They are counted as they will be in memory: float32.
    """
    size, most = 4 * (11 + 3 * (degree + 1) ** 2) * count, most_unpacked(packed)
    if size > most:
        raise ValueError(f"it promises {count} Gaussians, {size} bytes; {packed} compressed bytes may become {most}")


def leave_out_broken(path: Path, g: Gaussians, *, strict: bool) -> tuple[Gaussians, Tensor]:  # and [N] bool
    """Leave out the Gaussians that cannot be drawn, with their labels and columns: NaN, infinity, and rows of zeros.

    Rows of zeros, which truncated exports have, have no rotation and repeat each other. Another quaternion of length 0 is
    read as no rotation: rasterisers do the same. Each kind is noted. A ValueError if nothing is left, or if `strict`.

    Returns:
        The others, and which rows of the file they are.
    """
    if not len(g):
        return g, torch.ones(0, dtype=torch.bool)
    tensors = {name: getattr(g, name) for name in _RULES if name != "scores" and getattr(g, name) is not None}
    finite = {name: value.float().isfinite().reshape(len(g), -1).all(1) for name, value in tensors.items()}
    broken = ~torch.stack(list(finite.values())).all(0)
    unturned = (g.quats.norm(dim=1) <= _SHORTEST) & ~broken
    empty = unturned.clone()
    rows = torch.cat([g.means, g.scales, g.opacities[:, None]], 1)[unturned]
    _, same, counts = rows.unique(dim=0, return_inverse=True, return_counts=True)
    empty[unturned] = counts[same] > 1
    kept = ~(broken | empty)
    bad = ", ".join(name for name, good in finite.items() if not good.all())
    left_out = _count(broken, f"have NaN or infinity in {bad}") + _count(empty, "are rows of zeros")
    if left_out and (strict or not kept.any()):
        advice = "read another file, for example an earlier step of the training"
        advice = "without --strict they are left out" if kept.any() else advice
        raise ValueError(f"{path}: expected Gaussians with finite values, got others: {'; '.join(left_out)}; {advice}")
    notes = [f"{words}: left out" for words in left_out]
    notes += [f"{words}: read as not turned" for words in _count(unturned & kept, "have a rotation of length 0")]
    if g.labels is not None:
        unknown = g.labels == _UNKNOWN
        notes += [f"{words}: read as no class" for words in _count(unknown & kept, "have no number as class_id")]
        g = g.replace(labels=g.labels.masked_fill(unknown, -1))
    if g.scores is not None:
        notes += [f"{words}: read as 0" for words in _count(~g.scores.isfinite() & kept, "have no number as score")]
        g = g.replace(scores=g.scores.nan_to_num(0.0, 0.0, 0.0))
    for note in notes:
        tell(f"{path.name}: {note}")
    return g.replace(quats=known_quats(g.quats)).select(kept) if notes else g, kept


def _count(rows: Tensor, what: str) -> list[str]:  # rows: [N] bool
    """How many rows of a file there are, and where."""
    places = rows.nonzero()[:, 0].tolist()
    where = ", ".join([*map(str, places[:_SHOWN]), *["..."] * (len(places) > _SHOWN)])
    word = "row" if len(places) == 1 else "rows"
    return [f"{len(places):,} of {len(rows):,} Gaussians {what} ({word} {where})"] if places else []


def positive_scales(scales: NDArray[np.float32]) -> Tensor:  # [N, 3] float32
    """Linear scales as read, zeros raised to 1e-10. Negative ones become NaN; if most are, it is another format (ValueError)."""
    negative = (scales < 0).any(1)
    if 2 * negative.sum() > len(scales):
        first = scales[int(negative.argmax())].tolist()
        raise ValueError(f"scales of 0 or more, got {first} and others: is it another format?")
    usable = np.where(scales < 0, np.float32("nan"), scales)
    return torch.from_numpy(np.where(scales == 0, np.float32(_TINY_SCALE), usable))


def up_to_degree_3(path: Path, sh: Tensor) -> Tensor:  # [N, K, 3] -> [N, at most 16, 3]
    """Harmonics as `Gaussians` holds them; a note says if there are more."""
    if sh.shape[1] > 16:
        tell(f"{path.name}: spherical harmonics of degree 4: read up to degree 3")
    return sh[:, :16]


def whole_labels(values: NDArray[Any]) -> Tensor:  # [N] -> [N] int64
    """Labels of any type of numbers; NaN is `_UNKNOWN` until `leave_out_broken`. A ValueError for one that is not whole."""
    unknown = ~np.isfinite(values)
    values = np.where(unknown, 0, values)
    whole = (values == np.trunc(values)) & (np.abs(values.astype(np.float64)) < 2**53)
    if not whole.all():
        row = int((~whole).argmax())
        raise ValueError(f"class_id: {values[row]} at Gaussian {row} is not a whole number; name scores 'score'")
    return torch.from_numpy(np.where(unknown, _UNKNOWN, values.astype(np.int64)))


def flip_axes(g: Gaussians, axes: tuple[int, int, int]) -> Gaussians:
    """Flip the axes with sign -1: means change sign, rotations become S R S, harmonics change sign by their parity."""
    signs = dict(zip("xyz", axes, strict=True))
    x, y, z = axes
    means, quats = g.means.new_tensor([x, y, z]), g.quats.new_tensor([1, y * z, x * z, x * y])
    sh = None
    if g.sh is not None:
        parity = [float(np.prod([signs[axis] for axis in odd])) for odd in ("", *_ODD)]
        sh = g.sh * g.sh.new_tensor(parity[: g.sh.shape[1]])[:, None]
    place = [value * axis + 0.0 for value, axis in zip(g.origin, axes, strict=True)]  # + 0: no negative zeros
    return g.replace(means=g.means * means + 0.0, quats=g.quats * quats + 0.0, sh=sh, origin=as_origin(place))


def known_quats(quats: Tensor) -> Tensor:  # [N, 4] wxyz twice
    """The quaternions; those of length 0, which are no rotation at all, become the identity, as in the rasteriser."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype)
    return torch.where(quats.norm(dim=1, keepdim=True) > _SHORTEST, quats, identity)


def unit_quats(quats: Tensor) -> Tensor:  # [N, 4] wxyz -> [N, 4] of length 1
    """Quaternions of length 1; those of length 0 become the identity."""
    known = known_quats(quats)
    return known / known.norm(dim=1, keepdim=True)


def check_splats(gaussians: Gaussians) -> None:
    """Check a cloud before it is written, for the values that readers refuse. They are checked as float32, as stored.

    A quaternion of length 0 is refused, too: other programs divide by its length. In a file, it is read as no rotation.
    Opacities of exactly 0 and 1 are allowed: the PLY, which stores logits, keeps them within 1e-7.
    """
    g = gaussians.detach()
    for name, (expected, rule) in _RULES.items():
        if (values := getattr(g, name)) is not None:
            _check_rows(name, expected, values.float(), rule(values.float()))
    for name, column in g.extra.items():
        if np.asarray(column).dtype.kind not in "biuf" or (name == "class_id" and g.labels is not None):
            raise ValueError(
                f"extra[{name!r:.80}]: expected numbers, under another name than the labels' class_id, got "
                f"{np.asarray(column).dtype}; number them, or leave the column out"
            )
    if g.labels is not None:
        most = len(g.names) - 1 if g.names else _LABELS
        expected = f"-1 (none) to {most}" + (" (the named classes)" if g.names else "")
        _check_rows("labels", expected, g.labels, (g.labels >= -1) & (g.labels <= most))


def _check_rows(name: str, expected: str, values: Tensor, good: Tensor) -> None:  # [N, ...] twice
    if good.all():
        return
    bad = ~good.reshape(len(good), -1).all(1)
    row = int(bad.nonzero()[0])
    raw = values.isfinite().all() and 2 * int(bad.sum()) > len(bad) and name in _RAW
    advice = _RAW[name] if raw else "correct them, or leave these Gaussians out"
    raise ValueError(
        f"{name}: expected {expected} in every Gaussian, got {values[row].flatten()[:4].tolist()} at {row} and others at "
        f"{int(bad.sum()) - 1} more of {len(bad)}; {advice}"
    )


def describe_loss(g: Gaussians, name: str, holds: frozenset[str]) -> list[str]:
    """Describe what a format has no place for, of all that a cloud can have; `holds` is the format's `HOLDS`."""
    lost = []
    if "harmonics" not in holds and g.sh is not None and g.sh.shape[1] > 1:
        lost.append(f"spherical harmonics of degree {int(g.sh.shape[1] ** 0.5) - 1}: {name} holds the base colour only")
    if "features" not in holds and g.features is not None:
        lost.append(f"{g.features.shape[1]} features per Gaussian: {name} has no place for them")
    scores = [SCORE] if "columns" not in holds and g.labels is None and g.scores is not None else []
    columns = [*scores, *(() if "columns" in holds else g.extra)]
    if columns:
        lost.append(f"the columns {', '.join(columns)}: {name} has no place for them")
    if "antialiased" not in holds and g.antialiased:
        lost.append(f"antialiased rendering: {name} has no place for it")
    return lost


def describe_coarse(g: Gaussians, errors: Any, name: str) -> list[str]:  # errors: number or [N, 3], world units
    """Describe positions that a format rounds so much that Gaussians move by more than twice their own size."""
    off = torch.as_tensor(errors, dtype=torch.float64).expand(len(g), 3).norm(dim=1)
    moved = off > 2 * g.scales.amax(1) if len(g) else off > 0
    if not moved.any():
        return []
    return [
        f"positions of {int(moved.sum()):,} of {len(g):,} Gaussians, which move by up to {off[moved].max().item():.3g} units, "
        f"more than their own size: {name} has too few digits for a cloud this wide; .ply and .glb keep them"
    ]


def describe_cut(values: Tensor, low: float, high: float, what: str, name: str) -> list[str]:  # values: [N, ...]
    """Describe the loss of a format that holds values in 256 steps from `low` to `high`: those beyond become the ends."""
    step = (high - low) / 255
    count = int(((values < low - step) | (values > high + step)).flatten(1).any(1).sum())
    return [f"{what} of {count} of {len(values)} Gaussians beyond what {name} holds: cut off"] if count else []
