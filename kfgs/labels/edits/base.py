"""What every edit is: plain data that turns one cloud into another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from typing import Any, ClassVar

import torch
from torch import Tensor

from ...formats.splat_file import SplatFile
from ...gaussians import Gaussians
from .._json import members_of
from ..where import OfClass, Where

SHOWN = 12  # classes listed in a message


class Edit(ABC):
    """One edit: frozen plain data, so that it can be compared, saved and replayed.

    `op` names it in JSON. Nothing that is given to `apply` is changed.
    """

    op: ClassVar[str]

    @abstractmethod
    def apply(self, splats: SplatFile) -> SplatFile:
        """The edited cloud.

        Raises:
            ValueError: if it selects nothing and `allow_empty` was not asked for, or the cloud lacks what it needs.
        """

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `op`, and the fields."""
        return {"op": self.op} | members_of(self)


def as_where(value: Any) -> Where:
    """A selection as it is; a name stands for the class of that name.

    Raises:
        TypeError: if it is neither.
    """
    if not isinstance(value, str | Where):
        raise TypeError(
            f"where: expected a Where, such as OfClass('chair'), or a class name, got {value!r:.80}; build one"
        )
    return OfClass(value) if isinstance(value, str) else value


def selected(where: Where, splats: SplatFile, allow_empty: bool) -> Tensor:  # [N] bool
    """The mask of a selection; an empty one is refused, for a name mistyped would otherwise pass for an edit.

    Raises:
        ValueError: if nothing is selected and `allow_empty` is false; the message lists the classes present.
    """
    mask = where.mask(splats)
    if not allow_empty and not bool(mask.any()):
        raise ValueError(
            f"where: expected a selection of some of {len(splats)} Gaussians, got none from {where!r:.120}; "
            f"{_present(splats)}, or allow none (in Python: allow_empty=True)"
        )
    return mask


def scatter(gaussians: Gaussians, mask: Tensor, changed: Gaussians) -> Gaussians:
    """The cloud with the Gaussians under the mask exchanged, in place and order."""
    out: dict[str, Any] = {name: values for name, values in vars(gaussians).items() if values is not None}
    for name, values in out.items():
        out[name] = values.clone()
        out[name][mask] = getattr(changed, name)
    return Gaussians(**out)


def _present(splats: SplatFile) -> str:
    labels = splats.gaussians.labels
    if labels is None:
        return "the cloud carries no labels: widen the box or sphere"
    found, counts = torch.unique(labels[labels >= 0], return_counts=True)
    sizes: Counter[str] = Counter()
    for label, count in zip(found.tolist(), counts.tolist(), strict=True):
        sizes[class_name(splats.classes, label)] += count
    named = [f"{name} ({count})" for name, count in sizes.most_common()]
    more = f" and {len(named) - SHOWN} more" if len(named) > SHOWN else ""
    return f"classes present are {', '.join(named[:SHOWN]) or 'none'}{more}: select one of them"


def class_name(classes: tuple[str, ...], index: int) -> str:
    """The name of a class; one without a name is called `class 7`."""
    return classes[index] if index < len(classes) else f"class {index}"
