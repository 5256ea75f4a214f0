"""LEGaussians' scores on its masks of Mip-NeRF 360: IoU, accuracy, precision and average precision of relevancy maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kfgs.cameras.resample import resize_labels
from kfgs.evaluation.method import Method, View, annotated, check_level
from kfgs.evaluation.report import Report, Row, make_report, mean
from kfgs.evaluation.texts import Encode
from kfgs.labels.scores import CANONICAL, TEMPERATURE

from .lerf_2d import relevancies
from .mask_truth import MaskTruth
from .relevancy import check_relevancy
from .truth.find import open_masks

EPS = 1e-6  # the official script adds it to the denominators of IoU and precision
STEPS = 101  # thresholds, and levels of recall: 0, 0.01, ..., 1


def mask_scores(
    predicted: Tensor,  # [H, W] bool
    truth: Tensor,  # [H, W] bool
) -> dict[str, float]:
    """IoU (the union + 1e-6), accuracy (share of equal pixels) and precision tp / (tp + fp + 1e-6) of one mask."""
    hits = int((predicted & truth).sum())
    return {
        "IoU": hits / (int((predicted | truth).sum()) + EPS),
        "accuracy": float((predicted == truth).double().mean()),
        "precision": hits / (int(predicted.sum()) + EPS),
    }


def average_precision(
    relevancy: Tensor,  # [H, W]
    truth: Tensor,  # [H, W] bool
) -> float:
    """The sum over recalls r = 0, 0.01, ..., 1 of the best precision at a recall of at least r. Divide it by 100 or by 101.

    Precision and recall are taken at the thresholds 0, 0.01, ..., 1 of the relevancy (strictly above). The official script
    divides by 100 although there are 101 terms, so a perfect map scores 1.01. Nothing above a threshold, or nothing true,
    is a precision or a recall of 0.

    Example:
        >>> average_precision(torch.tensor([[0.9, 0.2]]), torch.tensor([[True, False]]))
        101.0
    """
    thresholds = torch.arange(STEPS, dtype=torch.float64) / (STEPS - 1)
    values, truth = relevancy.flatten().double().cpu(), truth.flatten().cpu()
    passed = torch.searchsorted(thresholds, values)  # how many thresholds lie strictly below a value
    counts = [torch.bincount(some, minlength=STEPS + 1) for some in (passed, passed[truth])]
    above, hits = (count.flip(0).cumsum(0).flip(0)[1:].double() for count in counts)  # [101]: values above threshold i
    precision, recall = hits / above.clamp_min(1), hits / max(int(truth.sum()), 1)
    reached = recall[None] >= thresholds[:, None]  # [r, threshold]
    return float((precision[None] * reached).amax(1).sum())


@dataclass(frozen=True)
class LEGaussiansMasks:
    """LEGaussians' `render_mask.py` and `eval.py`: relevancy maps, cut at 0.5, against masks of texts.

    Means are taken over the texts of a picture, then over the pictures. Masks are brought to the size of the view by nearest
    neighbour. Pixels without an answer count as the least relevant ones of their map.
    """

    name: ClassVar[str] = "legaussians-mip360/1"
    about: ClassVar[str] = (
        "LEGaussians' masks of Mip-NeRF 360: relevancy >= 0.5; mIoU, accuracy, precision and mAP, mean over the texts of a "
        "picture, then over the pictures; mAP/100 is the published sum of 101 terms divided by 100"
    )
    open = staticmethod(open_masks)

    threshold: float = 0.5
    """A pixel belongs to a text at or above it; nothing is smoothed or stretched."""
    scale: float = TEMPERATURE
    """Of the cosines in the relevancy: 10 in the published configuration; the code's default is 100."""
    negatives: tuple[str, ...] = CANONICAL
    """What texts are compared with."""
    level: int = 0
    """Of a method with several."""

    def __post_init__(self) -> None:
        check_relevancy(self.scale, self.negatives, self.threshold)

    def score(self, method: Method, truth: MaskTruth, views: Sequence[View], encode: Encode) -> Report:
        """Look for the texts of each annotated picture.

        Raises:
            ValueError: if a picture has no view.
        """
        check_level(method, self.level)
        rows: list[Row] = []
        for view in annotated(views, truth.frames):
            asked = truth.frames[view.stem]
            if not asked:
                continue
            each = []
            for text, found in relevancies(method, view, tuple(asked), encode, self.negatives, self.scale):
                seen = found[self.level].cpu()
                known = resize_labels(asked[text].mask.long().cpu(), view.camera.size).bool()
                area = average_precision(seen, known)
                each.append(mask_scores(seen >= self.threshold, known) | {"AP/100": area / 100, "AP/101": area / 101})
            rows.append({"view": view.stem} | {name: sum(one[name] for one in each) / len(each) for name in each[0]})
        names = {
            "mIoU": "IoU",
            "accuracy": "accuracy",
            "precision": "precision",
            "mAP/100": "AP/100",
            "mAP/101": "AP/101",
        }
        scores = {name: mean(row[key] for row in rows) for name, key in names.items()}
        return make_report(self, method.name, scores, rows)
