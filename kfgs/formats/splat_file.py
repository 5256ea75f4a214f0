"""What a splat file holds, whichever program wrote it, and how exactly a format can hold it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from torch import Tensor

from .._card import html_card, short_repr, short_value
from ..gaussians import Gaussians
from .ply import Columns

SCORE = "score"  # the extra column that says how sure a Gaussian's label is


@dataclass(frozen=True, eq=False)
class SplatFile:
    """A cloud as read from, or to be written to, a splat file.

    **Convention**: axes are those of the 3DGS PLY (x right, y down, z forward where the file keeps COLMAP's frame);
    formats that store others turn them when reading and writing.
    """

    gaussians: Gaussians
    """N Gaussians with activated values; colour in `sh`, classes in `labels`."""
    extra: Columns = field(default_factory=dict)
    """Other columns of the file, by name: one value per Gaussian (`score` belongs to the label)."""
    classes: tuple[str, ...] = ()
    """The name of each class index in `labels`; empty if the file has no names."""
    info: dict[str, Any] = field(default_factory=dict)
    """Facts about the file that JSON can hold: `format`, and what the header says. `antialiased` and `surfels` say for which
    kind of drawing the cloud was trained (`render_mode`). A format that has no place for them reports them as lost."""

    writer: ClassVar[Callable[..., Written]]
    """What `save` calls: `table.write_splats`, which sets it. The formats import this file, and the table knows the formats."""

    def __post_init__(self) -> None:
        for name, values in self.extra.items():
            if np.shape(values) != (len(self.gaussians),):
                raise ValueError(
                    f"extra[{name!r}]: expected [N] with N = {len(self.gaussians)} (from gaussians), got "
                    f"{np.shape(values)}; give one value per Gaussian"
                )

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        classes = f", {len(self.classes)} classes" if self.classes else ""
        extra = f", extra {short_value(list(self.extra))}" if self.extra else ""
        return f"SplatFile({self.info.get('format', 'new')}: {self.gaussians!r}{classes}{extra})"

    def _repr_html_(self) -> str:
        facts: dict[str, object] = {"format": self.info.get("format", "new"), "gaussians": repr(self.gaussians)}
        if self.classes:
            facts["classes"] = f"{len(self.classes)}: {', '.join(self.classes)}"
        return html_card("SplatFile", facts | {"other columns": ", ".join(self.extra) or None})

    def replace(self, **changes: Any) -> SplatFile:
        """A copy with some parts exchanged."""
        return replace(self, **changes)

    def save(self, path: str | Path, *, format: str | None = None) -> Written:
        """Write the cloud in the format that the ending of `path` names; see `write_splats`, which this calls."""
        return SplatFile.writer(path, self, format=format)

    def select(self, which: Tensor) -> SplatFile:  # which: [N] bool or [n] int64
        """The Gaussians under a mask or an index, with their extra columns."""
        index = which.detach().cpu().numpy()
        extra = {name: np.ascontiguousarray(values[index]) for name, values in self.extra.items()}
        return replace(self, gaussians=self.gaussians.select(which), extra=extra)


class Written(NamedTuple):
    """What `write_splats` left behind."""

    paths: list[Path]  # the file, and those beside it
    lost: tuple[str, ...]  # what the format could not hold, in words
    order: Tensor | None  # [N] int64: row i of the file is Gaussian order[i] of the cloud; None: the cloud's own order

    def __repr__(self) -> str:
        return short_repr(self)


class Precision(NamedTuple):
    """How far a value may be off after it was written and read again. Each format states it, and the tests hold it to that."""

    means: float | Tensor  # world units, per axis: one number, or [N, 3]
    scales: float  # relative, of each standard deviation
    rotation: float  # radians between the rotations
    opacities: float  # absolute
    sh0: float  # absolute, of the degree-0 coefficients
    sh_rest: float  # absolute, of the higher coefficients
    degree: int = 3  # highest degree of spherical harmonics that it holds

    def __repr__(self) -> str:
        return short_repr(self)
