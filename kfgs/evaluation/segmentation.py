"""Segmentation scores under a named protocol: one pooled confusion matrix over the views of a split."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from .._card import short_repr
from .._check import as_tensor
from ..cameras.resample import resize_labels
from ..metrics import ConfusionMatrix, Score
from .label_pictures import load_label_map
from .truth import Merged, merge_table

PROTOCOL = (
    "kfgs-pooled/1: one confusion matrix over all views, mean IoU over the classes that occur in truth or prediction, "
    "void (255) ignored, predictions resized to the truth by nearest neighbour"
)


@dataclass(frozen=True, eq=False)
class SegmentationReport:
    """Scores of one set of predictions."""

    names: tuple[str, ...]
    confusion: Tensor  # [C, C] int64, rows = truth
    misses: Tensor  # [C] int64, pixels of each true class that no class was predicted for
    iou: Tensor  # [C], NaN where a class occurs in neither
    miou: Score
    accuracy: Score
    views: int

    __repr__ = short_repr

    def __str__(self) -> str:
        rows = [f"{self.miou}", f"{self.accuracy}", f"over {self.views} views; IoU by class:"]
        rows += [f"  {name:<16s} {float(value):.3f}" for name, value in zip(self.names, self.iou, strict=True)]
        return "\n".join(rows)

    def to_json(self) -> dict[str, Any]:
        """The scores as plain numbers; classes that occur in neither truth nor prediction are null."""
        iou = [None if value != value else value for value in self.iou.tolist()]
        return {
            "protocol": self.miou.protocol,
            "views": self.views,
            "miou": self.miou.value,
            "accuracy": self.accuracy.value,
            "iou": dict(zip(self.names, iou, strict=True)),
            "confusion": self.confusion.tolist(),
            "misses": self.misses.tolist(),
        }


def check_truth(target: Tensor, classes: int, name: str) -> None:  # target: [H, W] int64
    """Raise a ValueError that begins with `name` if a true label has no class; call it before long work."""
    if target.numel() and int(target.max()) >= classes:
        raise ValueError(
            f"{name}: expected labels below {classes} (from names), got {int(target.max())}; "
            "is this the label picture of another set of classes?"
        )


def evaluate_segmentation(
    predict: Any,  # stem -> labels [h, w]: a mapping, a function or a field
    truth: Mapping[str, Path | Tensor],  # stem -> label picture, or its labels [H, W] with -1 = void
    names: Any,
    *,
    merged: Merged = (),
) -> SegmentationReport:
    """Score predicted label maps against label pictures (protocol `kfgs-pooled/1`).

    Args:
        predict: the label map of each view by its stem (mapping or function), at any size; -1 is wrong where truth is known.
            A field segments its own views; for others, `lambda stem: field.segment(scene[stem])`.
        truth: one label picture, or array, per view.
        names: class names, or what has them (a label set); a label is an index into them.
        merged: pairs of names: the first class counts as the second, in truth and prediction.

    Raises:
        ValueError: if there is nothing to score, or a truth label has no name.
    """
    names = tuple(getattr(names, "names", names))
    if not truth:
        raise ValueError("truth: expected at least one label picture, got none; is the folder of labels right?")
    answer = getattr(predict, "get" if isinstance(predict, Mapping) else "segment", predict)
    pooled, table = ConfusionMatrix(len(names)), merge_table(names, merged)
    for stem, given in truth.items():
        place = str(given) if isinstance(given, str | Path) else f"truth[{stem!r}]"
        target = load_label_map(given) if isinstance(given, str | Path) else as_tensor(place, given)
        check_truth(target, len(names), place)
        labels = as_tensor(f"predict({stem!r})", answer(stem))
        if labels.shape != target.shape:
            labels = resize_labels(labels, (int(target.shape[0]), int(target.shape[1])))
        pooled.update(labels, target)
    pooled.merge(table)
    if int(pooled.matrix.sum() + pooled.misses.sum()) == 0:
        raise ValueError(f"truth: expected some pixel with a known label, got only void in {len(truth)} views")
    return SegmentationReport(
        names=names,
        confusion=pooled.matrix,
        misses=pooled.misses,
        iou=pooled.iou(),
        miou=Score("mIoU", pooled.miou(), PROTOCOL),
        accuracy=Score("accuracy", pooled.accuracy(), PROTOCOL),
        views=len(truth),
    )
