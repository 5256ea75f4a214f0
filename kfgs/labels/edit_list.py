"""Edits in order, saved as JSON and replayed; and the edit that inserts another splat file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from .._card import cut
from .._check import as_tensor
from .._files import as_path, read_json, real_path, write_json
from .._notes import tell
from ..cameras.similarity import Similarity
from ..formats.table import read_splats
from ..gaussians import Gaussians
from .edits import Duplicate, Edit, Extract, Move, Opacity, Recolor, Remove, numbered_after, transformed
from .selection import class_names, read_object, set_fields
from .transfer import as_cloud

FORMAT, VERSION = "kfgs.edits", 1


@dataclass(frozen=True)
class Insert(Edit):
    """Add the Gaussians of another splat file after those of the scene. Classes of the same name become the same class.

    The file is read when the edit is applied. All is drawn as the scene is, with or without antialiasing; harmonics of a
    lower degree are padded with zeros. What one of the two lacks is filled: labels with -1, scores and other columns with 0.
    If the scene numbers its things (`number_instances`), what is inserted gets new numbers; if not, it has none either.
    """

    op: ClassVar[str] = "insert"
    source: str | Path
    """A splat file of any known format."""
    similarity: Similarity | None = None
    """From the axes of the source to those of the scene, also as a matrix [4, 4]; None: both have the same axes."""

    def __post_init__(self) -> None:
        if not isinstance(self.source, str | Path) or self.source == "":
            raise TypeError(f"source: expected the path of a splat file, got {self.source!r:.80}; pass one")
        if self.similarity is not None and not isinstance(self.similarity, Similarity):
            matrix = as_tensor("similarity", self.similarity, floating=True).double()
            set_fields(self, similarity=Similarity.from_matrix(matrix))

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        gaussians, part = as_cloud(gaussians), read_splats(self.source)
        if self.similarity is not None:
            part = transformed(part, self.similarity, gaussians.origin)
        return join(gaussians, part)

    def seen_from(self, folder: Path) -> Insert:
        """The edit as a list in the folder keeps it: with a path relative to the folder if the file lies in it, else in full."""
        path, folder = real_path(self.source), real_path(folder)
        return replace(self, source=path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path))

    def placed_in(self, folder: Path, name: str, *, anywhere: bool) -> Insert:
        """The edit of a list in the folder, to apply. Its file must lie there or below (links followed), unless `anywhere`."""
        path = folder / self.source
        if not anywhere and not Path(os.path.realpath(path)).is_relative_to(real_path(folder)):
            got = f"{str(self.source)!r:.200}; copy it there, or load with anywhere=True if you trust these edits"
            raise ValueError(f"{name}.source: expected a file in {folder} or below, got {got}")
        if not os.path.exists(path):
            raise FileNotFoundError(f"{name}.source: expected a splat file at {path!s:.400}, got none; put it there")
        return replace(self, source=path)


OPS: dict[str, type[Edit]] = {op.op: op for op in (Remove, Extract, Recolor, Opacity, Move, Duplicate, Insert)}


@dataclass(frozen=True)
class EditList:
    """Edits that are applied one after the other; `then` and `undo` give new lists, `apply` a new cloud.

    Example:
        >>> edits = EditList().then(Recolor("plant", "#c04040")).then(Remove("chair"))
        >>> len(edits), len(edits.undo())
        (2, 1)
    """

    edits: tuple[Edit, ...] = ()
    """The edits that `apply` applies, in order."""

    def __post_init__(self) -> None:
        edits = self.edits
        if not isinstance(edits, list | tuple) or not all(isinstance(edit, Edit) for edit in edits):
            raise TypeError(f"edits: expected a list of edits, got {edits!r:.80}; write it as [Remove('chair')]")
        set_fields(self, edits=tuple(edits))

    def __repr__(self) -> str:
        return f"EditList({len(self)} edits: {cut(', '.join(map(repr, self.edits[:9])), 140)})"

    def __len__(self) -> int:
        return len(self.edits)

    def __iter__(self) -> Iterator[Edit]:
        return iter(self.edits)

    def then(self, edit: Edit) -> EditList:
        """The list with one more edit."""
        return EditList((*self.edits, edit))

    def undo(self) -> EditList:
        """The list without its last edit."""
        return EditList(self.edits[:-1])

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The cloud after all edits; a ValueError says which one cannot be done."""
        gaussians = as_cloud(gaussians)
        for i, edit in enumerate(self.edits):
            try:
                gaussians = edit.apply(gaussians)
            except ValueError as error:
                raise ValueError(f"edits[{i}] ({edit.op}): {error}") from error
        return gaussians

    def save(self, path: str | Path) -> Path:
        """Write the list as JSON. Files to insert that lie in its folder or below are named relative to it, others in full."""
        path = as_path(path)
        edits = [edit.seen_from(path.parent) if isinstance(edit, Insert) else edit for edit in self.edits]
        write_json(path, {"format": FORMAT, "version": VERSION, "edits": [edit.to_json() for edit in edits]})
        return path

    @staticmethod
    def load(path: str | Path, *, anywhere: bool = False) -> EditList:
        """Read what `save` wrote. Files to insert must lie in the folder of the JSON file or below, unless `anywhere`.

        A ValueError names the place of an edit that is unknown or wrong.
        """
        path = as_path(path)
        content = read_json(path)
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
            raise ValueError(f"{path}: expected edits ('format': {FORMAT!r}, 'version': {VERSION}), got something else")
        name = f"{path}: edits"
        edits = [
            edit.placed_in(path.parent, f"{name}[{i}]", anywhere=anywhere) if isinstance(edit, Insert) else edit
            for i, edit in enumerate(read_edits(content.get("edits"), name))
        ]
        return EditList(tuple(edits))


def read_edits(values: Any, name: str = "edits") -> tuple[Edit, ...]:
    """Edits from plain values (`Edit.to_json`) that anyone may have written; a ValueError begins with their place, `name`."""
    if not isinstance(values, list):
        raise ValueError(f"{name}: expected a list of edits, got {values!r:.80}; write it as [...]")
    return tuple(read_object(f"{name}[{i}]", value, OPS, "op") for i, value in enumerate(values))


def join(first: Gaussians, second: Gaussians) -> Gaussians:
    """The Gaussians of two clouds, the first before the second, as `Insert` does it; a ValueError if only one has colours."""
    second = second.to(first.means.device, first.means.dtype).with_origin(first.origin)
    if (first.sh is None) != (second.sh is None):
        which = "the scene" if first.sh is None else "what is inserted"
        raise ValueError(f"sh: expected colours in both clouds, got none in {which}; choose one with colours")
    if second.antialiased != first.antialiased:
        tell(f"what is inserted has antialiased={second.antialiased}; it is drawn as the scene: {first.antialiased}")
    labels, names = _in_classes_of(first, second)
    second = numbered_after(first, second.replace(labels=labels, names=names, antialiased=first.antialiased))
    degrees = max(0 if cloud.sh is None else cloud.sh.shape[1] for cloud in (first, second))
    columns = {**first.extra, **second.extra}

    def filled(cloud: Gaussians, other: Gaussians) -> Gaussians:
        empty = {"labels": torch.full_like(cloud.opacities, -1).long(), "scores": torch.zeros_like(cloud.opacities)}
        missing = [name for name in empty if getattr(cloud, name) is None and getattr(other, name) is not None]
        sh = None if cloud.sh is None else torch.nn.functional.pad(cloud.sh, (0, 0, 0, degrees - cloud.sh.shape[1]))
        extra = {name: cloud.extra.get(name, np.zeros(len(cloud), values.dtype)) for name, values in columns.items()}
        return cloud.replace(**{name: empty[name] for name in missing}, sh=sh, names=names, extra=extra)

    return Gaussians.cat([filled(first, second), filled(second, first)])


def _in_classes_of(first: Gaussians, second: Gaussians) -> tuple[Tensor | None, tuple[str, ...]]:
    """The labels of the second cloud as classes of the first, after which come the classes that it lacks; and all names.

    A class without a name is called `class 7` if the other cloud has names; if neither has names, indices are kept.
    """
    if second.labels is None or not (first.names or second.names):
        return second.labels, first.names
    names, theirs, labels = list(class_names(first)), class_names(second), second.labels.clone()
    for label in second.labels[second.labels >= 0].unique().tolist():
        names += [] if theirs[label] in names else [theirs[label]]
        labels[second.labels == label] = names.index(theirs[label])
    return labels, tuple(names)
