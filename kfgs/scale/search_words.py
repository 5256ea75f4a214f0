"""Questions that an index answers by words: a word's score stands for those of its Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from .._card import error_line
from .._check import as_tensor, check_whole, one_line
from .._rows import unit_embeddings
from ..fields import SemanticField
from ..labels import LabelSet, Score, connected_parts, select_by_similarity
from ..labels.label_set import teacher_difference
from ..labels.parts import SPECK
from ..labels.questions import make_question
from ..labels.scores import similarity_threshold
from .search_file import Array, Contents, Entry, Table
from .search_found import PartFound, SceneFound, part_found, ranked, scene_found


def ask_words(
    contents: Contents,
    entries: Sequence[Entry],
    target: str | Tensor,
    classes: LabelSet | None,
    options: dict[str, Any],  # threshold, negatives, score
) -> tuple[list[SceneFound], dict[str, str]]:
    """What the words say about some fields, and the fields that cannot be asked. Errors are those of `SearchIndex.search`.

    Fields of one space that are asked with the same classes share the words' scores.
    """
    if not isinstance(target, str):
        target = as_tensor("target", target, floating=True)
    found, unasked, errors = list[SceneFound](), dict[str, str](), list[ValueError]()
    scores: dict[tuple[int, int | None], tuple[Tensor, float | None] | ValueError] = {}
    for entry in entries:
        table = None if classes is not None else table_to_ask(contents, entry, target)
        key = (entry.space, table)
        if key not in scores:
            try:
                asked = classes if table is None else label_set(contents.tables[table])
                cosines = _word_cosines(contents, entry.space, target, asked, options["negatives"])
            except ValueError as error:
                scores[key] = error
            else:
                scores[key] = _word_scores(*cosines, options["threshold"], options["score"])
        known = scores[key]
        if isinstance(known, ValueError):
            unknown = isinstance(target, str) and str(known).startswith("class")
            unasked[entry.path] = f"no class {target!r}" if unknown else one_line(known, 160)
            errors.append(known)
        else:
            found.append(_word_answer(entry, *known))
    if errors and not found and len(unasked) == len(contents.entries):
        raise errors[0]
    return found, unasked


def ask_fields(
    folder: Path,
    contents: Contents,
    found: Sequence[SceneFound],
    count: int,
    target: str | Tensor,
    classes: LabelSet | None,
    options: dict[str, Any],
) -> tuple[list[SceneFound], dict[str, str]]:
    """Put the question to the fields themselves, for the first `count` scenes; those that are exact already stay.

    Returns:
        All scenes, and the fields that could not be read, with the reason: they keep the answer by words.
    """
    check_whole("exact", count, 1)
    result, refused = list(found[count:]), dict[str, str]()
    for one in found[:count]:
        if one.exact:
            result.append(one)
            continue
        entry = contents.entries[one.path]
        table = None if classes is not None else table_to_ask(contents, entry, target)
        try:
            field = SemanticField.load(folder / one.path)
        except (OSError, ValueError) as error:
            refused[one.path] = f"itself: {error_line(error)}"
            result.append(one)
            continue
        asked = classes if table is None else label_set(contents.tables[table])
        selection = field.query(target, asked, **options)
        parts = connected_parts(field.gaussians, selection, field.cameras or None)
        views = [part.best_view for part in parts]
        shown = (
            PartFound(
                part.count,
                part.score,
                tuple(part.centroid.tolist()),
                tuple(part.extent[0].tolist()),
                tuple(part.extent[1].tolist()),
                None if view is None else view.camera,
                0.0 if view is None else view.share,
            )
            for part, view in zip(parts, views, strict=True)
        )
        mean = float(selection.scores[selection.mask].double().mean()) if len(selection) else 0.0
        result.append(scene_found(entry, len(selection), mean, True, shown))
    return list(ranked(result)), refused


def example_of(contents: Contents, path: Path, index: int) -> tuple[Tensor, dict[str, Entry], float]:
    """The feature [D] of a Gaussian, the entries of fields of the same teacher, and the tolerance of their words."""
    field = SemanticField.load(path)
    check_whole("index", index, 0, len(field) - 1)
    row = field.own_features(torch.tensor([index]))[0]
    if not bool(row.any()):
        raise ValueError(
            f"index: expected a Gaussian that a training view shows, got {index}, which none shows; name another"
        )
    space = find_space(contents, field)
    mine = {name: entry for name, entry in contents.entries.items() if entry.space == space}
    if space is None or not mine:
        raise ValueError(
            f"like: expected a field of the teacher of those in the index, got {path} of another; name another"
        )
    return row, mine, contents.spaces[space].tolerance


def find_space(contents: Contents, field: SemanticField) -> int | None:
    """The space of a field's teacher; None if no field of that teacher is in the index."""
    teacher = teacher_of(field)
    for i, one in enumerate(contents.spaces):
        same = teacher_difference({"teacher": one.teacher}, {"teacher": teacher}) is None
        if same and one.words.shape[1] == field.dim and (one.teacher is None) == (teacher is None):
            return i
    return None


def teacher_of(field: SemanticField) -> dict[str, Any] | None:
    """What a field says of its teacher; None if it says nothing."""
    teacher = field.info.get("teacher")
    return teacher if isinstance(teacher, dict) else None


def table_to_ask(contents: Contents, entry: Entry, target: str | Tensor) -> int | None:
    """The table in which a field's question is put: its own, unless only another one of its space knows the name."""
    if not isinstance(target, str):
        return entry.table
    same = [i for i, table in enumerate(contents.tables) if table.space == entry.space and i != entry.table]
    own = [] if entry.table is None else [entry.table]
    knowing = (i for i in own + same if label_set(contents.tables[i]).knows(target))
    return next(knowing, next(iter(own + same), None))


def label_set(table: Table) -> LabelSet:
    """A table of the index as a label set."""
    negatives = torch.from_numpy(table.negatives) if len(table.negatives) else None
    return LabelSet(table.names, torch.from_numpy(table.embeddings), negatives, table.negative_names, table.info)


def _word_cosines(
    contents: Contents, space: int, target: str | Tensor, classes: LabelSet | None, negatives: Any
) -> tuple[Tensor, Tensor | None]:  # [K], [K, M]
    """The cosines of a space's words with the target and its negatives; a ValueError if it is another teacher's question."""
    one = contents.spaces[space]
    info = {"teacher": one.teacher}
    other = None if classes is None else teacher_difference(info, classes.info)
    if other is not None:
        raise ValueError(f"another teacher: {other[0]} {other[1]!r:.40} instead of {other[2]!r:.40}")
    if classes is None and isinstance(target, str):
        raise ValueError(f"class: expected one that a field knows, got {target!r:.60}, and no classes could be read")
    asked = make_question(target, classes, negatives, one.words.shape[1], info)
    words = torch.from_numpy(one.words)
    near = words @ unit_embeddings(asked.row[None].to(words), "target")[0]
    return near, None if asked.negatives is None else words @ unit_embeddings(asked.negatives.to(words), "negatives").T


def _word_scores(
    near: Tensor, others: Tensor | None, threshold: float | None, score: Score | None
) -> tuple[Tensor, float | None]:  # [K]
    """The score of each word, and gamma; None if gamma follows from the scores of a field's Gaussians."""
    found = select_by_similarity(near, others, threshold, score=score)
    relevant = others is not None and score in (None, "relevancy")
    return found.scores, found.threshold if relevant or threshold is not None else None


def _word_answer(entry: Entry, scores: Tensor, gamma: float | None) -> SceneFound:  # scores [K]
    """The atoms whose word is selected, joined to parts."""
    atoms = entry.rows["atoms"]
    own = scores[torch.from_numpy(atoms["word"].astype(np.int64))]
    if gamma is None:
        gamma = similarity_threshold(own, torch.from_numpy(atoms["count"].astype(np.int64)))[0]
    mask, score = (own > gamma).numpy(), own.double().numpy()
    total = int(atoms["count"][mask].sum())
    mean = float(np.average(score[mask], weights=atoms["count"][mask])) if total else 0.0
    return scene_found(entry, total, mean, False, _joined(entry, mask, score))


def _joined(entry: Entry, mask: Array, score: Array) -> Iterator[PartFound]:  # [A] bool, [A]
    """Atoms that touch are one part; pooled ones have no place. The largest part first."""
    atoms, pairs = entry.rows["atoms"], entry.rows["links"]["pair"]
    chosen = np.flatnonzero(mask & (atoms["pooled"] == 0))
    if not len(chosen):
        return
    pairs = pairs[mask[pairs].all(axis=1)]
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(mask), len(mask)))
    part = np.unique(connected_components(graph, directed=False)[1][chosen], return_inverse=True)[1]
    counts = np.bincount(part, atoms["count"][chosen])
    order = np.argsort(-counts, kind="stable")
    for i in order[counts[order] >= SPECK * counts.max()].tolist():
        own = chosen[part == i]
        weight = atoms["count"][own].astype(float)
        views, shares = atoms["views"][own].ravel(), atoms["shares"][own].ravel()
        sums = np.bincount(views[views >= 0], shares[views >= 0], minlength=1)
        best = int(sums.argmax()) if sums.max() > 0 else -1
        rows = {
            "count": np.array([weight.sum()]),
            "score": np.array([np.average(score[own], weights=weight)]),
            "center": np.average(atoms["center"][own], axis=0, weights=weight)[None],
            "low": atoms["low"][own].min(axis=0)[None],
            "high": atoms["high"][own].max(axis=0)[None],
        }
        yield part_found(entry, rows, 0, best, float(sums.max()))
