"""Selections are data: which Gaussians, how well each one fits, why, and the algebra that combines them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._check import check_range, check_shapes
from .._rows import check_finite
from ..gaussians import Gaussians
from .boxes import OrientedBox
from .names import class_of, labelled


@dataclass(frozen=True, eq=False)
class Selection:
    """Some of N Gaussians, with a score for every one of them.

    `a & b`, `a | b`, `a ^ b`, `a - b` and `~a` combine selections of the same Gaussians. Scores follow Zadeh's rules:
    `&` takes the smaller, `|` the larger, `~a` has 1 - score; `a - b` is `a & ~b`, and `a ^ b` is `(a - b) | (b - a)`.
    `len` is the number selected, so an empty selection is false in an `if`.
    """

    mask: Tensor  # [N] bool
    scores: Tensor  # [N] how well each fits: a cosine or a relevancy; 1 and 0 where a place or a label decides
    threshold: float | None = None
    """Gamma of Sec. 3.4; None where no threshold was applied, or several were."""
    how: str = ""
    """Where the threshold comes from, or what was combined."""

    def __post_init__(self) -> None:
        check_shapes(("mask", self.mask, "N"), ("scores", self.scores, "N"))
        if self.mask.dtype != torch.bool:
            raise TypeError(f"mask: expected a boolean mask, got {self.mask.dtype}; compare first, as in labels == 3")
        check_finite("scores", self.scores)

    def __len__(self) -> int:
        return int(self.mask.sum())

    def __repr__(self) -> str:
        return f"Selection({len(self)} of {len(self.mask)} Gaussians: {self.words})"

    @property
    def indices(self) -> Tensor:  # [n] int64
        """The selected Gaussians, ascending."""
        return self.mask.nonzero()[:, 0]

    @property
    def words(self) -> str:
        """How it was made, with its threshold, for a person."""
        return self.how if self.threshold is None else f"score > {self.threshold:.4g} ({self.how})"

    def within(self, mask: Tensor, how: str) -> Selection:  # mask: [N] bool
        """The part of this selection under a mask: the same scores and threshold, one more reason."""
        check_shapes(("selection.mask", self.mask, "N"), ("mask", mask, "N"))
        return Selection(self.mask & mask, self.scores, self.threshold, f"{self.how}; {how}" if self.how else how)

    def __and__(self, other: Selection) -> Selection:
        scores = self._beside(other)
        return Selection(self.mask & other.mask, torch.minimum(*scores), None, f"({self.words}) and ({other.words})")

    def __or__(self, other: Selection) -> Selection:
        scores = self._beside(other)
        return Selection(self.mask | other.mask, torch.maximum(*scores), None, f"({self.words}) or ({other.words})")

    def __invert__(self) -> Selection:
        return Selection(~self.mask, 1 - self.scores, None, f"not ({self.words})")

    def __sub__(self, other: Selection) -> Selection:
        self._beside(other)
        return self & ~other

    def __xor__(self, other: Selection) -> Selection:
        self._beside(other)
        return (self - other) | (other - self)

    def _beside(self, other: Selection) -> tuple[Tensor, Tensor]:
        """Both scores, in one dtype; refuses what does not select among the same Gaussians."""
        if not isinstance(other, Selection):
            raise TypeError(
                f"other: expected a Selection, got {type(other).__name__}; make one, as in Selection(mask, mask.float())"
            )
        if len(self.mask) != len(other.mask):
            raise ValueError(
                f"other: expected a selection among the same {len(self.mask)} Gaussians, got one among "
                f"{len(other.mask)}; select in the same cloud, or carry the labels over with transfer_labels"
            )
        dtype = torch.promote_types(self.scores.dtype, other.scores.dtype)
        return self.scores.to(dtype), other.scores.to(self.scores.device, dtype)


def select_where(mask: Tensor, how: str = "given") -> Selection:  # mask: [N] bool
    """A selection from a mask alone: scores are 1 inside, 0 outside.

    Raises:
        TypeError: if the mask is not boolean.
    """
    return Selection(mask, mask.to(torch.get_default_dtype()), None, how)


def select_by_label(
    gaussians: Gaussians,
    label: int | str | Sequence[int | str],
    classes: Sequence[str] = (),
    scores: Tensor | None = None,  # [N]
) -> Selection:
    """Select the Gaussians that carry one of some labels.

    Args:
        gaussians: with labels.
        label: a class index, -1 (none), a class name, or several of them. A name is looked up exactly, then whatever its
            case; where several classes have it, all of them are meant.
        classes: the names of the classes, in label order; needed for names.
        scores: what each label is worth; 1 where selected and 0 elsewhere when not given.

    Raises:
        ValueError: if the Gaussians carry no labels, a name is unknown (the message offers near ones), or a label is no
            whole number from -1.
    """
    if gaussians.labels is None:
        raise ValueError("gaussians.labels: expected labels [N], got None; label them first, with classify or vote")
    plain: Any = label.tolist() if hasattr(label, "tolist") else label  # numpy's and torch's own numbers
    several = isinstance(plain, Iterable) and not isinstance(plain, str | bytes)
    asked = [class_of("label", one) for one in (plain if several else [plain])]
    mask = labelled(gaussians.labels, asked, classes)
    how = "label " + ", ".join(str(one) for one in asked)
    if scores is None:
        return select_where(mask, how)
    check_shapes(("gaussians.labels", gaussians.labels, "N"), ("scores", scores, "N"))
    return Selection(mask, scores, None, how)


def select_in_box(
    means: Tensor,  # [N, 3]
    box: OrientedBox | tuple[Sequence[float] | Tensor, Sequence[float] | Tensor],
) -> Selection:
    """Select the Gaussians whose means lie in a box, or on its faces.

    Args:
        means: positions, in world units.
        box: an oriented box, or the lowest and the highest corner of an axis-aligned one.

    Raises:
        ValueError: if shapes disagree, a number is not finite, or the lowest corner is above the highest.
    """
    check_shapes(("means", means, "N 3"))
    check_finite("means", means)
    if not isinstance(box, OrientedBox):
        box = OrientedBox.between(*box)
    size = " x ".join(f"{2 * float(half):.4g}" for half in box.half)
    return select_where(box.contains(means), f"in a box of {size}")


def select_in_sphere(
    means: Tensor,  # [N, 3]
    center: Sequence[float] | Tensor,  # [3]
    radius: float,
) -> Selection:
    """Select the Gaussians whose means are at most `radius` from a point.

    Args:
        means: positions, in world units.
        center: the point.
        radius: in world units.

    Raises:
        ValueError: if shapes disagree, a number is not finite, or the radius is negative.
    """
    place = torch.as_tensor(center, dtype=torch.float64, device=means.device)
    check_shapes(("means", means, "N 3"), ("center", place, "3"))
    check_finite("means", means)
    check_finite("center", place)
    check_range("radius", radius, 0)
    inside = ((means.double() - place) ** 2).sum(dim=1) <= radius**2
    return select_where(inside, f"within {radius:.4g} of ({', '.join(f'{x:.4g}' for x in place.tolist())})")
