"""The content of a splat file, independent of its format, and the precision of a format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from torch import Tensor

from .._card import LINE, cut, html_card, short_repr, short_value
from .._typed import typed
from ..gaussians import Gaussians
from .ply import Columns

SCORE = "score"  # the extra column with the confidence of a Gaussian's label


@typed
@dataclass(frozen=True, eq=False)
class SplatFile:
    """A cloud with the other content of a splat file.

    **Convention**: axes are those of the 3DGS PLY (in COLMAP's frame: x right, y down, z forward). Formats with other axes
    are converted when reading and writing.
    """

    gaussians: Gaussians
    """N Gaussians with activated values; colour in `sh`, classes in `labels`."""
    extra: Columns = field(default_factory=dict)
    """Other columns of the file, by name: one value per Gaussian (`score` belongs to the label)."""
    classes: tuple[str, ...] = ()
    """The name of each class index in `labels`; empty if the file has no names."""
    info: dict[str, Any] = field(default_factory=dict)
    """Details of the file, as JSON: `format`, and values of the header. `surfels` (true) are 2-D Gaussians (`render_mode`). A
    format that cannot store that, or `gaussians.antialiased`, reports it as lost."""

    notes: tuple[str, ...] = ()
    """What the reader left out or changed, and what is not drawn as the file says, in words. Commands print it."""

    _writer: ClassVar[Callable[..., Written]]
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
        return cut(f"SplatFile({self.info.get('format', 'new')}: {self.gaussians!r}{classes}{extra})", LINE)

    def _repr_html_(self) -> str:
        facts: dict[str, object] = {"format": self.info.get("format", "new"), "gaussians": repr(self.gaussians)}
        if self.classes:
            facts["classes"] = f"{len(self.classes)}: {', '.join(self.classes)}"
        return html_card("SplatFile", facts | {"other columns": ", ".join(self.extra) or None})

    def replace(self, **changes: Any) -> SplatFile:
        """A copy with some parts exchanged."""
        return replace(self, **changes)

    def save(self, path: str | Path, *, format: str | None = None, plain: bool = False) -> Written:
        """Write the cloud in the format that the ending of `path` names; see `write_splats`, which this calls."""
        return SplatFile._writer(path, self, format=format, plain=plain)

    def select(self, which: Tensor) -> SplatFile:  # which: [N] bool or [n] int64
        """The Gaussians under a mask or an index, with their extra columns."""
        index = which.detach().cpu().numpy()
        extra = {name: np.ascontiguousarray(values[index]) for name, values in self.extra.items()}
        return replace(self, gaussians=self.gaussians.select(which), extra=extra)

    def by_class(self) -> dict[int, SplatFile]:
        """One cloud for each label that some Gaussian has, ascending; -1 is the cloud without a class.

        Raises:
            ValueError: if there are no labels.
        """
        labels = self.gaussians.labels
        if labels is None:
            raise ValueError("gaussians: expected labels, got none; `kfgs.attach` or `label_splats` gives them some")
        return {label: self.select(labels == label) for label in labels.unique().tolist()}


class Written(NamedTuple):
    """The result of `write_splats`."""

    paths: list[Path]  # the splat file, and extra files next to it
    lost: tuple[str, ...]  # descriptions of what the format could not store
    order: Tensor | None  # [N] int64: row i of the file is Gaussian order[i] of the cloud; None: the same order

    def __repr__(self) -> str:
        return short_repr(self)


class Precision(NamedTuple):
    """The largest error of a value that was written and read again. Each format states it, and the tests check it."""

    means: float | Tensor  # world units, per axis: one number, or [N, 3]
    scales: float  # relative, of each standard deviation
    rotation: float  # radians between the rotations
    opacities: float  # absolute
    sh0: float  # absolute, of the degree-0 coefficients
    sh_rest: float  # absolute, of the higher coefficients
    degree: int = 3  # highest degree of spherical harmonics

    def __repr__(self) -> str:
        return short_repr(self)
