"""The edit that adds the Gaussians of another splat file, and how two clouds are joined."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..._check import as_tensor
from ..._files import real_path
from ...cameras.similarity import Similarity
from ...formats.table import read_splats
from ...gaussians import Gaussians
from ..where import set_fields
from .edit import Edit, class_name


@dataclass(frozen=True, eq=False)
class Insert(Edit):
    """Add the Gaussians of another splat file after those of the scene; `join` says what happens to labels and columns.

    The file is read when the edit is applied. Two inserts are equal if they have the same similarity and name the same file,
    relative to the working folder or in full.
    """

    op: ClassVar[str] = "insert"
    source: str | Path | Gaussians
    """A splat file of any known format, or a cloud in memory (which JSON cannot hold)."""
    similarity: Similarity | None = None
    """From the axes of the source to those of the scene, also as a matrix [4, 4]; None: both have the same axes."""

    def __post_init__(self) -> None:
        if not isinstance(self.source, str | Path | Gaussians) or self.source == "":
            raise TypeError(f"source: expected a path or Gaussians, got {self.source!r:.80}; pass one of them")
        if self.similarity is not None and not isinstance(self.similarity, Similarity):
            matrix = as_tensor("similarity", self.similarity, floating=True).double()
            set_fields(self, similarity=Similarity.from_matrix(matrix))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Insert) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key()[0])

    def _key(self) -> tuple[Any, Any]:
        source = id(self.source) if isinstance(self.source, Gaussians) else os.path.realpath(self.source)
        return source, None if self.similarity is None else self.similarity.matrix().tolist()

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`; reads the file if it is one."""
        from .motion import transformed

        part = self.source if isinstance(self.source, Gaussians) else read_splats(self.source)
        if self.similarity is not None:
            part = transformed(part, self.similarity, gaussians.origin)
        return join(gaussians, part)

    def to_json(self) -> dict[str, Any]:
        """See `Edit.to_json`.

        Raises:
            ValueError: if the source is a cloud in memory.
        """
        if isinstance(self.source, Gaussians):
            raise ValueError(
                "source: expected a path to save this edit, got Gaussians in memory; write them with write_splats and "
                "insert the file"
            )
        matrix = {} if self.similarity is None else {"similarity": self.similarity.matrix().tolist()}
        return {"op": self.op, "source": os.fspath(self.source), **matrix}

    def seen_from(self, folder: Path) -> Insert:
        """The same edit with its path relative to the folder if it lies in it, else in full."""
        if isinstance(self.source, Gaussians):
            return self
        path, folder = real_path(self.source), real_path(folder)
        inside = path.is_relative_to(folder)
        return replace(self, source=path.relative_to(folder).as_posix() if inside else str(path))

    def found_in(self, folder: Path, name: str, *, anywhere: bool) -> Insert:
        """The same edit of a saved list, with its path completed by the folder of the list.

        Raises:
            ValueError: if the file lies outside that folder (an absolute path, `..`, a link), unless `anywhere`.
            FileNotFoundError: if there is no such file.
        """
        assert not isinstance(self.source, Gaussians)
        path = folder / self.source
        if not anywhere and not Path(os.path.realpath(path)).is_relative_to(real_path(folder)):
            raise ValueError(
                f"{name}.source: expected a file in {folder} or below, got {str(self.source)!r:.200}; copy it there, or load "
                "with anywhere=True if you trust these edits"
            )
        if not os.path.exists(path):
            raise FileNotFoundError(f"{name}.source: expected a splat file at {path!s:.400}, got none; put it there")
        return replace(self, source=path)


def join(first: Gaussians, second: Gaussians) -> Gaussians:
    """The Gaussians of two clouds, the first before the second; dtype, device, origin and rendering are those of the first.

    - Spherical harmonics: the lower degree is padded with zeros, which changes no colour.
    - Labels: classes with the same name are the same class. If the first cloud has the name twice, the lowest label is
      used. New names that occur are added after those of the first. A class without a name is called `class 7` if the
      other cloud has names; if neither has names, indices are kept.
    - If one cloud lacks them: labels become -1 (none); scores, features and other columns 0.

    Raises:
        ValueError: if one has colours and the other has none, or their features have different channels.
    """
    second = second.with_origin(first.origin)
    if (first.sh is None) != (second.sh is None):
        which = "the scene" if first.sh is None else "what is inserted"
        raise ValueError(
            f"sh: expected colours in both clouds, got none in {which}; choose one with colours (in Python: or add them with "
            "gaussians.replace())"
        )
    if (
        first.features is not None
        and second.features is not None
        and first.features.shape[1] != second.features.shape[1]
    ):
        raise ValueError(
            f"features: expected as many channels in both clouds, got {first.features.shape[1]} and "
            f"{second.features.shape[1]}; insert a splat without features"
        )
    if first.antialiased != second.antialiased:
        how = ("fainter", "with") if first.antialiased else ("more opaque", "without")
        warnings.warn(
            f"insert: what is smaller than a pixel looks {how[0]} than in its own file: all is drawn {how[1]} antialiasing, as "
            "the scene is",
            stacklevel=2,
        )
    labels, names = _joined_labels(first, second)
    rows = {name: _padded(getattr(first, name), getattr(second, name), first, second) for name in JOINED}
    extra = {}
    for name in {**first.extra, **second.extra}:
        columns = [cloud.extra.get(name) for cloud in (first, second)]
        dtype = np.result_type(*[column for column in columns if column is not None])
        filled = [
            np.zeros(len(cloud), dtype) if column is None else column
            for cloud, column in zip((first, second), columns, strict=True)
        ]
        extra[name] = np.concatenate(filled)
    return first.replace(**rows, labels=labels, names=names, extra=extra)


JOINED = ("means", "quats", "scales", "opacities", "sh", "features", "scores")


def _padded(a: Tensor | None, b: Tensor | None, first: Gaussians, second: Gaussians) -> Tensor | None:
    """One tensor of both clouds; zeros where a cloud has none, or has fewer harmonics."""
    like = b if a is None else a
    if like is None:
        return None
    parts = [
        torch.zeros(len(cloud), *like.shape[1:]) if part is None else part for cloud, part in ((first, a), (second, b))
    ]
    if like.ndim == 3:
        most = max(part.shape[1] for part in parts)
        parts = [torch.nn.functional.pad(part, (0, 0, 0, most - part.shape[1])) for part in parts]
    return torch.cat([part.to(first.means) for part in parts])


def _joined_labels(first: Gaussians, second: Gaussians) -> tuple[Tensor | None, Sequence[str]]:
    if first.labels is None and second.labels is None:
        return None, first.names
    device = first.means.device
    old, new = (torch.full((len(cloud),), -1) if cloud.labels is None else cloud.labels for cloud in (first, second))
    old, new = old.to(device), new.to(device)
    if not first.names and not second.names:
        return torch.cat([old, new]), ()
    highest = int(old.max()) if len(old) else -1
    names = [class_name(first.names, i) for i in range(max(len(first.names), highest + 1))]
    renamed = new.clone()
    for label in torch.unique(new[new >= 0]).tolist():
        name = class_name(second.names, label)
        if name not in names:
            names.append(name)
        renamed[new == label] = names.index(name)
    return torch.cat([old, renamed]), tuple(names)
