"""One cloud of 3-D Gaussians with activated values: what every other module passes around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ._card import LINE, cut, short_value
from ._check import ORIGIN, as_array, as_origin, as_tensor, check_shapes

Array = np.ndarray[Any, Any]
TENSORS = ("means", "quats", "scales", "opacities", "features", "sh", "labels", "scores")
SHAPES = ("N 3", "N 4", "N 3", "N", "N D", "N K 3", "N", "N")


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N 3-D Gaussians with all that belongs to them: shape, colour or features, classes, and the other columns of a file.

    Values are **activated** (opacities from 0 to 1, scales as lengths); raw ones live only where training happens.

    **Convention**: quaternions are (w, x, y, z) and need not be unit (they are normalised where used); scales are
    standard deviations in world units; labels are class indices with -1 = none, and become int64. A semantic field carries
    `features`, a colour field `sh`. NumPy arrays are accepted and become tensors that share their memory.
    A scene far from zero (UTM, ECEF) has an `origin`: float32 has about 7 digits, so `means` are counted from there.

    `gaussians[mask]` (or an index, a slice, a `Selection`, a rule) is a new, smaller cloud; `len` counts the Gaussians.

    Example:
        >>> cloud = Gaussians(torch.eye(3), torch.ones(3, 4), torch.ones(3, 3), torch.tensor([0.1, 0.5, 0.9]))
        >>> cloud[cloud.opacities > 0.4]
        Gaussians(2 Gaussians, torch.float32, cpu)
        >>> cloud[-1].to_numpy()["means"].tolist()
        [[0.0, 0.0, 1.0]]
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] > 0
    opacities: Tensor  # [N] in (0, 1)
    features: Tensor | None = None  # [N, D]
    sh: Tensor | None = None  # [N, K, 3], K = (degree + 1)^2
    labels: Tensor | None = None  # [N] int64, -1 = none
    scores: Tensor | None = None  # [N] how sure each label is, from 0 to 1
    names: tuple[str, ...] = ()  # the name of each class index in `labels`; empty if they have none
    extra: Mapping[str, Array] = field(default_factory=dict)  # other columns of a file by name, one value per Gaussian
    origin: tuple[float, float, float] = ORIGIN  # where (0, 0, 0) lies in the world: add it to `means` in float64
    antialiased: bool = False  # trained with Mip-Splatting's filter: drawn with opacity compensation
    gaussians = property(lambda self: self, doc="The cloud itself, so that `read_splats(...).gaussians` works.")

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", as_origin(self.origin))
        object.__setattr__(self, "names", tuple(self.names))
        for name in TENSORS:
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, as_tensor(name, value, floating=name != "labels"))
        if self.labels is not None:
            if self.labels.is_floating_point() or self.labels.dtype == torch.bool:
                raise TypeError(f"labels: expected whole numbers, got {self.labels.dtype}; convert them with .long()")
            object.__setattr__(self, "labels", self.labels.long())  # unsigned ones have no -1
        columns = ((f"extra[{name!r}]", np.asarray(column), "N") for name, column in self.extra.items())
        check_shapes(
            *((name, getattr(self, name), shape) for name, shape in zip(TENSORS, SHAPES, strict=True)), *columns
        )
        if self.sh is not None and self.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {self.sh.shape[1]}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        parts = [f"{len(self)} Gaussians"]
        if self.features is not None:
            parts.append(f"{self.features.shape[1]} features")
        if self.sh is not None:
            parts.append(f"SH degree {int(self.sh.shape[1] ** 0.5) - 1}")
        parts += ["labelled"] * (self.labels is not None) + ["antialiased"] * self.antialiased
        parts += [f"{len(self.names)} classes"] if self.names else []
        parts += [f"columns {short_value(list(self.extra))}"] if self.extra else []
        return cut(f"Gaussians({', '.join(parts)}, {self.means.dtype}, {self.means.device})", LINE)

    def __array__(self, *args: Any, **kwargs: Any) -> Array:
        """None: without it, NumPy would look into g[0][0][0]... for numbers."""
        raise TypeError("gaussians: expected an array, got Gaussians, which hold several; use to_numpy()")

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that there are, by name."""
        return {name: value for name in TENSORS if (value := getattr(self, name)) is not None}

    def replace(self, **changes: Any) -> Gaussians:
        """A copy with some parts exchanged."""
        return replace(self, **changes)

    def with_origin(self, origin: Sequence[float]) -> Gaussians:  # [3]
        """The same places in the world, with `means` counted from another origin."""
        shift = [a - b for a, b in zip(self.origin, as_origin(origin), strict=True)]
        return self.replace(means=self.means + self.means.new_tensor(shift), origin=origin) if any(shift) else self

    def select(self, which: Any) -> Gaussians:
        """Some of the Gaussians as a new cloud; `gaussians[which]` is the same.

        Args:
            which: a mask [N], indices [n] in any order, a slice, one index, a `Selection`, or a rule like `OfClass`. Tensors,
                NumPy arrays and lists are taken.

        Raises:
            ValueError: if a mask is not [N].
            TypeError: if it is neither a mask nor whole numbers.
            IndexError: if there is no such Gaussian.
        """
        index = as_rows("which", which, self).to(self.means.device)
        extra = {name: np.asarray(column)[index.cpu().numpy()] for name, column in self.extra.items()}
        return self.replace(**{name: value[index] for name, value in self.tensors().items()}, extra=extra)

    __getitem__ = select

    def by_class(self) -> dict[int, Gaussians]:
        """One cloud for each label that occurs, ascending; -1 is the cloud without a class. A ValueError without labels."""
        if self.labels is None:
            raise ValueError("gaussians: expected labels, got none; `kfgs.attach` or `transfer_labels` gives them some")
        return {label: self.select(self.labels == label) for label in self.labels.unique().tolist()}

    def to(self, *args: Any, **kwargs: Any) -> Gaussians:
        """Move or convert the floating tensors as `Tensor.to` does; labels keep their integer type."""
        moved = {name: value.to(*args, **kwargs) for name, value in self.tensors().items() if name != "labels"}
        if self.labels is not None:
            moved["labels"] = self.labels.to(moved["means"].device)
        return self.replace(**moved)

    def detach(self) -> Gaussians:
        """The same values without their autograd history."""
        return self.replace(**{name: value.detach() for name, value in self.tensors().items()})

    def to_numpy(self) -> dict[str, Array]:
        """The tensors that there are as NumPy arrays, by name: `means` [N, 3], ..., for trimesh, Open3D or pandas."""
        return {name: as_array(value) for name, value in self.tensors().items()}

    @staticmethod
    def cat(parts: Sequence[Any]) -> Gaussians:
        """Concatenate clouds, or fields with their classes, of the same tensors and columns; the edit `Insert` joins others.

        A ValueError if there is nothing to join, or one cloud carries what another lacks.
        """
        if not parts:
            raise ValueError("parts: expected at least one Gaussians, got none")
        parts = [part.label() if hasattr(part, "label") else part for part in parts]
        first, names = parts[0], list(parts[0].tensors())
        for i, part in enumerate(parts):
            for what, expected, got in (
                ("tensors", names, list(part.tensors())),
                ("columns", sorted(first.extra), sorted(part.extra)),
                ("class names", first.names, part.names),
                ("origin", first.origin, part.origin),
                ("antialiased", first.antialiased, part.antialiased),
            ):
                if got != expected:
                    way = "with_origin()" if what == "origin" else "replace()"
                    raise ValueError(
                        f"parts[{i}]: expected the {what} {expected} as in parts[0], got {got}; bring them to one with {way}"
                    )
        tensors = {name: torch.cat([part.tensors()[name] for part in parts]) for name in names}
        extra = {name: np.concatenate([part.extra[name] for part in parts]) for name in first.extra}
        return first.replace(**tensors, extra=extra)


def as_rows(name: str, which: Any, cloud: Any) -> Tensor:  # [N] bool, or [n] whole numbers
    """Which Gaussians of a cloud or a field, in any form that `Gaussians.select` takes and with its errors, as an index."""
    which, count = which(cloud) if callable(which) else which, len(cloud)  # a rule of labels/selection.py is called
    which = getattr(which, "mask", which)
    if isinstance(which, slice):
        return torch.from_numpy(np.arange(*which.indices(count)))
    if not isinstance(which, Tensor):
        numbers = isinstance(which, int | np.integer | list | tuple | range) or hasattr(which, "__array__")
        if isinstance(which, Gaussians) or not numbers:
            got = f"{type(which).__name__}; pass a rule like OfClass('chair'), a Selection, a mask or indices"
            raise TypeError(f"{name}: expected a mask or whole numbers, got {got}")
        which = as_tensor(name, which)
    rows = torch.atleast_1d(which.long() if which.numel() == 0 and which.dtype != torch.bool else which)
    if rows.dtype == torch.bool and rows.shape != (count,):
        raise ValueError(f"{name}: expected a mask [N] with N = {count}, got {tuple(rows.shape)}")
    if rows.is_floating_point():
        raise TypeError(f"{name}: expected a mask or whole numbers, got {rows.dtype}; compare first, as in x > 0.5")
    if rows.dtype != torch.bool and bool((wrong := (rows < -count) | (rows >= count)).any()):
        raise IndexError(f"{name}: expected indices below {count} (the number of Gaussians), got {int(rows[wrong][0])}")
    return rows


def check_gaussians(value: object, name: str = "gaussians") -> None:
    """Raise a TypeError unless `value` is a cloud of Gaussians; the message says where it is, if `value` holds one."""
    if not isinstance(value, Gaussians):
        hint = f"pass {'its .gaussians, or .label(), with classes' if hasattr(value, 'gaussians') else 'Gaussians'}"
        raise TypeError(f"{name}: expected Gaussians, got {type(value).__name__}; {hint}")
