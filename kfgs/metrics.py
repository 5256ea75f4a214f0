"""Scores with their definitions: mIoU, accuracy, PSNR, SSIM, and bytes.

`kornia.metrics` compares pictures. What it leaves open is settled here: labels to ignore, pooling over views, classes
that do not occur, and which SSIM.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import kornia.metrics
import torch
from torch import Tensor

from ._check import as_tensor, check_range, check_shapes
from .cameras.resample import to_bchw

__all__ = ["ConfusionMatrix", "psnr", "semantic_storage_bytes", "ssim"]

MIB = 2**20
"""Bytes in the "MB" of Table 1."""
SSIM_WINDOW = 11
SSIM_PROTOCOL = (
    "kornia.metrics.ssim, Gaussian window 11x11 with sigma 1.5, padding='valid', mean over all pixels and channels"
)
_ATTRIBUTES = 3 + 3 + 1 + 3 + 4  # means, normals (always zero), opacity, scales, rotation


@dataclass(frozen=True)
class Score:
    """A number that does not travel without the protocol it was measured under.

    Example:
        >>> named = Score("mIoU", 0.7661, "kfgs-pooled/1: one confusion matrix over all views")
        >>> print(named)
        mIoU 0.766 (kfgs-pooled/1)
        >>> print(named.text)
        mIoU 0.7661 (kfgs-pooled/1: one confusion matrix over all views)
    """

    name: str
    value: float
    protocol: str
    """What was measured and how. Of "name/version: long text" only the name and the version are printed."""

    def __str__(self) -> str:
        named = re.match(r"[\w.-]+/\d+(?=:)", self.protocol)
        return f"{self.name} {self.value:.3f} ({named[0]})" if named else self.text

    @property
    def text(self) -> str:
        """The long form, with all that the protocol says."""
        return f"{self.name} {self.value:.4f} ({self.protocol})"


class ConfusionMatrix:
    """One confusion matrix, pooled over all views of an evaluation.

    **Convention**: rows are the truth. Where the truth is known and the prediction is -1 ("none"), the pixel is a miss
    of its class: it lowers that class's IoU and the accuracy, so that abstaining never pays.

    kornia's confusion matrix is not used: it has no ignored label, needs two classes, and returns float32, which is exact
    up to 2^24 counts.

    Args:
        classes: number of classes C.
        ignore: targets that are not scored, besides -1, which never is.

    Example:
        >>> pooled = ConfusionMatrix(3)
        >>> pooled.update(torch.tensor([0, 0]), torch.tensor([0, 1]))  # first view
        >>> pooled.update(torch.tensor([1]), torch.tensor([1]))  # second view
        >>> pooled.iou()
        tensor([0.5000, 0.5000,    nan], dtype=torch.float64)
        >>> pooled.miou()  # class 2 occurs nowhere and is left out
        0.5
    """

    def __init__(self, classes: int, *, ignore: int | Sequence[int] = -1) -> None:
        check_range("classes", classes, 1)
        self.classes = classes
        self.ignore = {-1, ignore} if isinstance(ignore, int) else {-1, *ignore}
        self._counts = torch.zeros(classes, classes + 1, dtype=torch.int64)  # the last column: no prediction

    def __repr__(self) -> str:
        return f"ConfusionMatrix({self.classes} classes, {int(self._counts.sum()):,} pixels)"

    @property
    def matrix(self) -> Tensor:  # [C, C] int64
        """Counts of (truth, prediction) where there was a prediction."""
        return self._counts[:, : self.classes].clone()

    @property
    def misses(self) -> Tensor:  # [C] int64
        """Scored pixels of each class that were predicted as -1 ("none")."""
        return self._counts[:, self.classes].clone()

    def update(self, pred: Tensor, target: Tensor) -> None:  # [...] integer, both
        """Add the labels of one view, or of any part of one.

        Raises:
            TypeError: if labels are not integers.
            ValueError: if shapes differ, or a label lies outside [0, classes) and is neither -1 nor ignored.
        """
        pred, target = as_tensor("pred", pred), as_tensor("target", target)
        check_shapes(("target", target, tuple(pred.shape)))
        for name, labels in (("pred", pred), ("target", target)):
            if labels.is_floating_point() or labels.is_complex() or labels.dtype == torch.bool:
                raise TypeError(f"{name}: expected integer labels, got {labels.dtype}; convert with .long()")
        pred, target = pred.flatten().long(), target.flatten().long()
        known = ~torch.isin(target, target.new_tensor([*self.ignore]))
        pred, target = pred[known], target[known]
        pred = pred.where(pred != -1, self.classes)
        self._check("pred", pred, self.classes + 1, "pass class indices, or -1 for none")
        self._check("target", target, self.classes, "pass other labels as `ignore`, or a larger `classes`")
        cells = target * (self.classes + 1) + pred
        self._counts += torch.bincount(cells, minlength=self._counts.numel()).view_as(self._counts).cpu()

    def merge(self, table: Tensor) -> None:  # [C + 1] int64
        """Count class k as class `table[k]` from now on, in truth and prediction; `table` ends with -1."""
        rows = torch.zeros_like(self._counts).index_add(0, table[:-1], self._counts)
        self._counts = torch.zeros_like(rows).index_add(1, table % (self.classes + 1), rows)  # -1: misses stay misses

    def _check(self, name: str, labels: Tensor, count: int, advice: str) -> None:
        if labels.numel() and not (labels.min() >= 0 and labels.max() < count):
            raise ValueError(
                f"{name}: expected labels in [0, {self.classes}), got {int(labels.min())} to {int(labels.max())}; {advice}"
            )

    def iou(self) -> Tensor:  # [C] float64
        """Intersection over union of each class; NaN for a class that occurs in neither truth nor prediction."""
        counts = self._counts.double()
        hits = counts.diagonal()
        union = counts.sum(dim=1) + counts[:, : self.classes].sum(dim=0) - hits
        return hits / union  # 0 / 0 = NaN

    def miou(self) -> float:
        """Mean IoU over the classes that occur (NaN if none does)."""
        return float(self.iou().nanmean())

    def accuracy(self) -> float:
        """Share of scored pixels that got their true class (NaN if nothing was scored)."""
        return float(self._counts.diagonal().sum().double() / self._counts.sum())


def psnr(
    image: Tensor,  # [H, W, C]
    target: Tensor,  # [H, W, C]
    *,
    peak: float = 1.0,
) -> Tensor:  # scalar
    """Peak signal-to-noise ratio in decibels, 10 log10(peak^2 / MSE) over all pixels and channels; infinite for equal pictures.

    Raises:
        ValueError: if shapes differ, or `peak` is not positive.

    Example:
        >>> psnr(torch.zeros(4, 4, 3), torch.full((4, 4, 3), 0.1))
        tensor(20.)
    """
    image, target = as_tensor("image", image), as_tensor("target", target)
    check_shapes(("target", target, tuple(image.shape)))
    check_range("peak", peak, 0, closed=(False, False))
    return kornia.metrics.psnr(image, target, peak)


def ssim(
    image: Tensor,  # [H, W, C]
    target: Tensor,  # [H, W, C]
    *,
    peak: float = 1.0,
) -> Tensor:  # scalar
    """Mean structural similarity under `SSIM_PROTOCOL`: only windows that lie wholly inside the picture count.

    Raises:
        ValueError: if shapes differ, a side is shorter than the window (11), or `peak` is not positive.

    Note:
        kornia's `eps` is set to 0: its default pulls dark pictures visibly below 1 even when they are equal.
    """
    image, target = as_tensor("image", image), as_tensor("target", target)
    check_shapes(("image", image, "H W C"), ("target", target, "H W C"))
    check_range("peak", peak, 0, closed=(False, False))
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"image: expected at least {SSIM_WINDOW} pixels on each side, got {tuple(image.shape)}")
    pair = to_bchw(image), to_bchw(target)
    return kornia.metrics.ssim(*pair, SSIM_WINDOW, max_val=float(peak), eps=0.0, padding="valid").mean()


def semantic_storage_bytes(gaussians: int, channels: int, decoder_parameters: int = 0, codebook_values: int = 0) -> int:
    """Bytes of a semantic field as the paper's Table 1 counts them; divide by `MIB` for its "MB".

    All in float32: per Gaussian 14 + d numbers (3 means, 3 normals that are always zero, opacity, 3 scales, 4 rotation,
    d latent channels), plus the decoder and the codebook. What kfgs writes to disk is smaller, and is measured on disk.

    Args:
        gaussians: number of Gaussians.
        channels: d, latent channels per Gaussian.
        decoder_parameters: weights and biases of Psi (831,744 for the paper's 9-32-64-128-256-1024-512).
        codebook_values: K times D.

    Example:
        >>> semantic_storage_bytes(1, 9)  # 23 float32
        92
    """
    return 4 * (gaussians * (_ATTRIBUTES + channels) + decoder_parameters + codebook_values)
