"""Feature 3DGS's score: how far a field's classes agree with its teacher's, without any ground truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import ClassVar

import torch
from torch import Tensor

from ..scenes.files import natural_key
from .method import LabelRule, Method, View, label_view
from .report import Report, Row, make_report, mean
from .texts import Encode, encode_unit
from .truth import Merged, merge_table

MERGED = (("television", "door"), ("rug", "floor"), ("pillow", "cushion"))  # of ADE20K's words
LARGEST = (360, 480)  # (height, width): wider views are scored at this size
SIZE = (119, 159)  # (height, width) to which both label maps are brought, "as in the NeRF baseline"
MOST = 7  # classes whose IoU is averaged


def teacher_agreement(
    teacher: Tensor,  # [H, W] int64, -1 = the teacher says nothing
    student: Tensor,  # [H, W] int64, -1 = the field knows nothing
    most: int = MOST,
) -> tuple[float, float]:
    """Accuracy and "IoU7": labels of both maps are counted together, the IoU of the `most` most frequent ones is averaged.

    Pixels where the teacher says nothing are left out; where only the student says nothing, it is wrong. Of equally
    frequent labels the lowest counts. NaN if no pixel is left.

    Example:
        >>> teacher_agreement(torch.tensor([[1, 1, 2, 2]]), torch.tensor([[1, 2, 2, 2]]))
        (0.75, 0.5833333333333333)
    """
    known = teacher >= 0
    teacher, student = teacher[known], student[known]
    if len(teacher) == 0:
        return float("nan"), float("nan")
    labels, counts = torch.cat([teacher, student[student >= 0]]).unique(return_counts=True)
    frequent = labels[counts.sort(descending=True, stable=True).indices[:most]]
    pairs = ((teacher == label, student == label) for label in frequent)
    ious = [int((a & b).sum()) / int((a | b).sum()) for a, b in pairs]
    return float((teacher == student).double().mean()), sum(ious) / len(ious)


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

    rule: ClassVar[LabelRule] = "nearest"
    """Every method takes the text with the largest cosine."""

    texts: tuple[str, ...] | None = None
    """The classes that are asked. None: LSeg's 150 classes of ADE20K as published. Its label file splits names at spaces, so
    "coffee" is asked for a coffee table, and "screen" twice; three pairs of classes are merged."""
    split: tuple[int, int] | None = (8, 2)
    """Of the views sorted by the numbers in their names, every 8th from index 2. None: all views that are given."""
    level: int = 0
    """The map of a method with several."""
    merged: Merged | None = None
    """As in `KfgsPooled`. None: those of `MERGED` with the published texts, else none."""

    def score(self, method: Method, truth: Method, views: Sequence[View], encode: Encode) -> Report:
        """Compare a method with its teacher, the method `truth`; `split` chooses some of the views.

        Raises:
            ValueError: if the split holds no view.
        """
        chosen = self.chosen(views)
        words, usual = (ade20k_words(), MERGED) if self.texts is None else (self.texts, ())
        text, table = encode_unit(encode, words), merge_table(words, usual if self.merged is None else self.merged)
        rows: list[Row] = []
        for view in chosen:
            if view.camera.width > LARGEST[1]:
                view = view._replace(camera=view.camera.resized(*LARGEST))
            pair = label_view(truth, view, text), label_view(method, view, text, self.level)
            taught, said = (_as_scored(table[labels.cpu()]) for labels in pair)
            accuracy, iou = teacher_agreement(taught, said)
            rows.append({"view": view.stem, "mIoU": iou, "accuracy": accuracy})
        scores = {name: mean(row[name] for row in rows) for name in ("mIoU", "accuracy")}
        step, first = self.split or (1, 0)
        note = (
            f"{len(chosen)} of {len(views)} views are scored: one in {step} from index {first}, in the order of the numbers "
            "in their names"
        )
        return make_report(self, method.name, scores, rows, [note] if self.split else [])

    def chosen(self, views: Sequence[View]) -> list[View]:
        """The views of `split`, sorted by the numbers in their names.

        Raises:
            ValueError: if there is none.
        """
        step, first = self.split or (1, 0)
        chosen = sorted(views, key=lambda view: natural_key(view.stem))[first::step]
        if not chosen:
            raise ValueError(f"views: expected more than {first}, got {len(views)}; pass split=None")
        return chosen


def _as_scored(labels: Tensor) -> Tensor:  # [H, W] -> SIZE
    """Labels resized as torch's "nearest" does: row i reads row floor(i H / h)."""
    rows, columns = (torch.arange(new) * old // new for new, old in zip(SIZE, labels.shape, strict=True))
    return labels[rows[:, None], columns]


def ade20k_words() -> list[str]:
    """LSeg's 150 words for ADE20K, as its label file has them."""
    text = files("kfgs.evaluation").joinpath("data", "ade20k.json").read_text("utf-8")
    words: list[str] = json.loads(text)["first-word"]
    return words
