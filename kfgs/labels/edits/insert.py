"""The edit that adds the Gaussians of another splat file, and how two clouds are joined."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from ..._check import as_tensor
from ..._files import real_path
from ...cameras.similarity import Similarity
from ...formats.table import read_splats
from ...gaussians import Gaussians
from ..where import set_fields
from .edit import Edit, class_name
from .motion import transformed


@dataclass(frozen=True)
class Insert(Edit):
    """Add the Gaussians of another splat file after those of the scene; `join` says what happens to labels and columns.

    The file is read when the edit is applied.
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

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`; reads the file if it is one."""
        part = self.source if isinstance(self.source, Gaussians) else read_splats(self.source)
        if self.similarity is not None:
            part = transformed(part, self.similarity, gaussians.origin)
        return join(gaussians, part)

    def to_json(self) -> dict[str, Any]:
        """See `Edit.to_json`; a ValueError if the source is a cloud in memory."""
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
    - Labels: classes with the same name are the same class, new ones come after those of the first. A class without a name
      is called `class 7` if the other cloud has names; if neither has names, indices are kept.
    - What one of them lacks: labels become -1 (none); scores, features and other columns 0.

    Raises:
        ValueError: if one has colours and the other has none, or their features have different channels.
    """
    second = second.to(first.means.device, first.means.dtype).with_origin(first.origin)
    if (first.sh is None) != (second.sh is None):
        which = "the scene" if first.sh is None else "what is inserted"
        raise ValueError(f"sh: expected colours in both clouds, got none in {which}; choose one with colours")
    if first.antialiased != second.antialiased:
        how = ("fainter", "with") if first.antialiased else ("more opaque", "without")
        warnings.warn(
            f"insert: what is smaller than a pixel looks {how[0]} than in its own file: all is drawn {how[1]} antialiasing, as "
            "the scene is",
            stacklevel=2,
        )
    names = first.names
    if (first.names or second.names) and second.labels is not None:
        highest = -1 if first.labels is None or not len(first) else int(first.labels.max())
        known = [class_name(first.names, i) for i in range(max(len(first.names), highest + 1))]
        renamed = second.labels.clone()
        for label in second.labels[second.labels >= 0].unique().tolist():
            name = class_name(second.names, label)
            known += [] if name in known else [name]
            renamed[second.labels == label] = known.index(name)
        second, names = second.replace(labels=renamed), tuple(known)
    clouds = (first, second)
    degrees = max(0 if cloud.sh is None else cloud.sh.shape[1] for cloud in clouds)
    channels = {cloud.features.shape[1] for cloud in clouds if cloud.features is not None}
    if len(channels) > 1:
        raise ValueError(f"features: expected as many channels in both clouds, got {sorted(channels)}; drop one side's")
    columns = {**first.extra, **second.extra}

    def alike(cloud: Gaussians) -> Gaussians:
        n, like = len(cloud), cloud.means
        sh = None if cloud.sh is None else torch.nn.functional.pad(cloud.sh, (0, 0, 0, degrees - cloud.sh.shape[1]))
        fill = {"labels": torch.full((n,), -1, device=like.device), "scores": like.new_zeros(n)}
        fill |= {"features": like.new_zeros(n, *channels)}
        lacks = {name for name in fill if getattr(cloud, name) is None}
        wanted = {name for name in lacks if any(getattr(other, name) is not None for other in clouds)}
        extra = {name: cloud.extra.get(name, np.zeros(n, values.dtype)) for name, values in columns.items()}
        filled = {name: fill[name] for name in wanted}
        return cloud.replace(**filled, sh=sh, names=names, extra=extra, antialiased=first.antialiased)

    return Gaussians.cat([alike(first), alike(second)])
