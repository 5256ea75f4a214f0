"""Feature 3DGS's score: how far a field's classes agree with its teacher's, without any ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from .._check import check_choice, check_size, check_whole
from ..scenes.files import natural_key
from .class_lists import load_classes
from .method import Method, View, label_view
from .relevancy import Encode, encode_unit
from .report import Report, Row, make_report, mean


class Agreement(NamedTuple):
    """How far two label maps agree."""

    accuracy: float
    """Share of equal pixels."""
    iou: float
    """Mean IoU of the classes that are most frequent in both maps together."""


def merge_labels(labels: Tensor, merged: Sequence[tuple[int, int]]) -> Tensor:  # [...] int64 -> [...] int64
    """Replace the first label of each pair by the second, in order."""
    for old, new in merged:
        labels = labels.where(labels != old, new)
    return labels


def resize_by_corners(labels: Tensor, size: tuple[int, int]) -> Tensor:  # [H, W] -> [h, w]
    """Resize labels as torch's "nearest" does: row i reads row floor(i H / h), the label at the pixel's corner."""
    rows, columns = (torch.arange(new) * old // new for new, old in zip(size, labels.shape, strict=True))
    return labels[rows.to(labels.device)[:, None], columns.to(labels.device)]


def teacher_agreement(
    teacher: Tensor,  # [H, W] int64, -1 = the teacher says nothing
    student: Tensor,  # [H, W] int64, -1 = the field knows nothing
    most: int = 7,
) -> Agreement:
    """Accuracy and "IoU7": the labels of both maps are counted together, the `most` most frequent ones have their IoU averaged.

    Pixels where the teacher says nothing are left out; where only the student says nothing, it is wrong. Of equally
    frequent labels the lowest counts. NaN if no pixel is left.

    Example:
        >>> teacher_agreement(torch.tensor([[1, 1, 2, 2]]), torch.tensor([[1, 2, 2, 2]]))
        Agreement(accuracy=0.75, iou=0.5833333333333333)
    """
    known = teacher >= 0
    teacher, student = teacher[known], student[known]
    if len(teacher) == 0:
        return Agreement(float("nan"), float("nan"))
    labels, counts = torch.cat([teacher, student[student >= 0]]).unique(return_counts=True)
    frequent = labels[counts.sort(descending=True, stable=True).indices[:most]]
    ious = []
    for label in frequent:
        a, b = teacher == label, student == label
        ious.append(int((a & b).sum()) / int((a | b).sum()))
    return Agreement(float((teacher == student).double().mean()), sum(ious) / len(ious))


@dataclass(frozen=True)
class TeacherAgreement:
    """Feature 3DGS's `encoders/lseg_encoder/segmentation_metric.py`: agreement of two argmax maps, the field's and the teacher's.

    It needs no labels, so it runs with any teacher and any scene. It does not say whether either is right.

    Note:
        The official script resizes rendered features to the teacher's map. Here field and teacher are both asked at the
        size of the view's camera; `TeacherMethod(maps, align_corners=True)` resizes the teacher as the script does.
    """

    name: ClassVar[str] = "feature3dgs-teacher/1"
    about: ClassVar[str] = (
        "agreement of the field's classes with the teacher's in views: accuracy, and the mean IoU of the 7 most frequent "
        "classes of both; mean over the views; no ground truth"
    )

    texts: Literal["first-word", "full"] | tuple[str, ...] = "first-word"
    """LSeg's label file splits names at spaces, so the published numbers ask "coffee" for a coffee table, and "screen" twice.
    "full" asks whole names. A tuple asks other classes, for instance those of a teacher that knows its own."""
    merged: tuple[tuple[int, int], ...] = ((90, 15), (29, 4), (58, 40))
    """Classes that become others, counted from 1: television to door, rug to floor, pillow to cushion. Not for other texts."""
    split: tuple[int, int] | None = (8, 2)
    """Of the views sorted by the numbers in their names, every 8th from index 2. None: all views that are given."""
    largest: tuple[int, int] = (360, 480)
    """(height, width): wider views are scored at this size."""
    size: tuple[int, int] = (119, 159)
    """(height, width) to which both label maps are brought, "as in the NeRF baseline"."""
    most: int = 7
    """How many classes the IoU is averaged over."""
    level: int = 0
    """Of a method with several."""

    def __post_init__(self) -> None:
        if isinstance(self.texts, str):
            check_choice("texts", self.texts, ("first-word", "full"))
        if self.split is not None:
            check_whole("split (step)", self.split[0], 1)
            check_whole("split (first)", self.split[1], 0)
        check_size(self.largest, "largest")
        check_size(self.size)
        check_whole("most", self.most, 1)

    def score(self, method: Method, truth: Method, views: Sequence[View], encode: Encode) -> Report:
        """Compare a method with its teacher.

        Args:
            method: the field.
            truth: the teacher, a `TeacherMethod` or any other method.
            views: all views of the scene; `split` chooses some, and a note says how many.
            encode: the teacher's text encoder.

        Raises:
            ValueError: if the split holds no view.
        """
        chosen = self.chosen(views)
        asked = load_classes("ade20k")[self.texts] if isinstance(self.texts, str) else self.texts
        merged = [(old - 1, new - 1) for old, new in self.merged] if isinstance(self.texts, str) else []
        text = encode_unit(encode, asked)
        rows: list[Row] = []
        for view in chosen:
            if view.camera.width > self.largest[1]:
                view = view._replace(camera=view.camera.resized(*self.largest))
            maps = (label_view(one, view, text, self.level if one is method else 0) for one in (truth, method))
            taught, found = (resize_by_corners(merge_labels(labels.cpu(), merged), self.size) for labels in maps)
            accuracy, iou = teacher_agreement(taught, found, self.most)
            rows.append({"view": view.stem, "mIoU": iou, "accuracy": accuracy})
        scores = {name: mean(row[name] for row in rows) for name in ("mIoU", "accuracy")}
        return make_report(self, method.name, scores, rows, self._notes(len(chosen), len(views)))

    def _notes(self, scored: int, given: int) -> list[str]:
        if self.split is None:
            return []
        step, first = self.split
        return [
            f"{scored} of {given} views are scored: one in {step} from index {first}, in the order of the numbers in their "
            "names; split=none scores all"
        ]

    def chosen(self, views: Sequence[View]) -> list[View]:
        """The views of `split`, sorted by the numbers in their names.

        Raises:
            ValueError: if there is none.
        """
        ordered = sorted(views, key=lambda view: natural_key(view.stem))
        found = ordered if self.split is None else ordered[self.split[1] :: self.split[0]]
        if not found:
            raise ValueError(
                f"views: expected more than {(self.split or (0, 0))[1]}, got {len(ordered)}; pass split=None"
            )
        return found
