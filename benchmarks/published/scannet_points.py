"""OpenGaussian's score on ScanNet: the classes of Gaussians that stand at the vertices of the mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kfgs._check import check_choice, check_range
from kfgs.evaluation.method import Method, View, best_labels, check_level
from kfgs.evaluation.report import Report, Row, make_report, mean
from kfgs.evaluation.scannet import nyu40_names
from kfgs.evaluation.texts import Encode, encode_unit
from kfgs.evaluation.truth import PointTruth, name_key
from kfgs.gaussians import Gaussians
from kfgs.scenes.files import some

from .class_lists import load_classes
from .truth.find import open_points

COUNTS = (19, 15, 10)  # how many classes the published tables have


def class_scores(
    predicted: Tensor,  # [P] int64, -1 = none
    truth: Tensor,  # [P] int64, -1 = not scored
    classes: int,
    weights: Tensor | None = None,  # [P]
) -> dict[str, Tensor]:  # [C] float64 each
    """IoU and recall of each class over the points with a true class; NaN for classes that the truth lacks.

    Args:
        predicted: class indices.
        truth: class indices.
        classes: C.
        weights: what each point counts; 1 if None.

    Example:
        >>> found = class_scores(torch.tensor([0, 1, 1, 0]), torch.tensor([0, 0, 1, -1]), 2)
        >>> found["IoU"].tolist(), found["recall"].tolist()
        ([0.5, 0.5], [0.5, 1.0])
    """
    scored = truth >= 0
    predicted, truth = predicted[scored], truth[scored]
    amount = torch.ones(len(truth), dtype=torch.float64) if weights is None else weights[scored].double().cpu()

    def total(labels: Tensor, among: Tensor) -> Tensor:  # [C]
        return torch.bincount(labels[among].cpu(), amount[among.cpu()], minlength=classes)

    hits, true = total(truth, predicted == truth), total(truth, truth >= 0)
    union = true + total(predicted, predicted >= 0) - hits
    return {"IoU": (hits / union).where(true > 0, torch.nan), "recall": (hits / true).where(true > 0, torch.nan)}


def scannet_classes(count: int) -> tuple[list[int], list[str]]:
    """The NYU40 ids and names of OpenGaussian's 19, 15 or 10 classes.

    Raises:
        ValueError: if there is no such list.
    """
    check_choice("classes", count, COUNTS)
    lists = load_classes("scannet")
    ids: list[int] = lists[str(count)]
    names = nyu40_names()
    return ids, [names[i] for i in ids]


def class_indices(labels: Tensor, ids: Sequence[int]) -> Tensor:  # [P] int64 -> [P] int64
    """Labels of a data set as indices into some of its ids; -1 for all other labels."""
    found = torch.full_like(labels, -1)
    for i, label in enumerate(ids):
        found[labels == label] = i
    return found


def scannet_labels(truth: PointTruth, ids: Sequence[int], names: Sequence[str]) -> Tensor:  # [P] int64
    """The labels of a truth as indices into some classes of NYU40; -1 for all others.

    Raises:
        ValueError: if the truth calls an id by another name than NYU40, so that its labels are another data set's, or if no
            point has one of the classes.
    """
    other = [
        f"{i} = {truth.names[i]!r}"
        for i, name in zip(ids, names, strict=True)
        if i in truth.names and name_key(truth.names[i]) != name_key(name)
    ]
    if other:
        raise ValueError(
            f"truth: expected ids of NYU40 ({ids[0]} = {names[0]!r}, ...), got {some(other, 3)}; give ScanNet's labels "
            "(*_vh_clean_2.labels.ply), or use kfgs-surface/1 or scenesplat-fmiou/1, which go by names"
        )
    found = class_indices(truth.labels.cpu(), ids)
    if not bool((found >= 0).any()):
        raise ValueError(
            f"truth: expected points of some of the {len(ids)} classes ({some(list(names), 3)}), got none among {len(found)}; "
            "are these the labels of the scene?"
        )
    return found


def predict_classes(
    method: Method, names: Sequence[str], encode: Encode, *, level: int, unknown: str
) -> tuple[Gaussians, Tensor]:  # and [N] int64
    """The Gaussians of a method, and the class of each.

    Raises:
        TypeError: if it has none.
    """
    if method.gaussians is None:
        raise TypeError(f"method: expected one with Gaussians, got {method.name!r} without; use a protocol of views")
    check_level(method, level)
    labels = best_labels(method.gaussian_cosines(encode_unit(encode, names))[level])
    return method.gaussians, labels.clamp_min(0) if unknown == "first class" else labels


def report_classes(
    protocol: object, method: Method, names: Sequence[str], found: dict[str, Tensor], accuracy: float
) -> Report:
    """The report of IoU and recall by class."""
    rows: list[Row] = [
        {"class": name, "IoU": iou, "recall": recall}
        for name, iou, recall in zip(names, found["IoU"].tolist(), found["recall"].tolist(), strict=True)
        if iou == iou
    ]
    scores = {"mIoU": mean(row["IoU"] for row in rows), "mAcc": mean(row["recall"] for row in rows)}
    return make_report(protocol, method.name, scores | {"accuracy": accuracy}, rows)


@dataclass(frozen=True)
class ScanNetPoints:
    """OpenGaussian's `scripts/eval_scannet.py`. Gaussian i is vertex i of the mesh: positions are frozen, nothing is densified.

    The scene's score is the mean over the classes that its truth has, after the opacity rule; a table is the plain mean of
    scenes. For Gaussians that moved or were densified use `scannet-volume/1`, or `assign="nearest"` and say so.
    """

    name: ClassVar[str] = "scannet-points/1"
    about: ClassVar[str] = (
        "ScanNet as OpenGaussian scores it: Gaussian i is vertex i and takes its most similar class; vertices whose Gaussian "
        "is transparent (opacity < 0.1) are not scored; mIoU and mAcc over the classes of the scene's truth"
    )
    open = staticmethod(open_points)

    classes: int = 19
    """19, 15 or 10 classes of NYU40, by bare names ("showercurtain" is one word)."""
    least_opacity: float = 0.1
    """A vertex whose Gaussian is less opaque is not scored. It inflates the score of a method that has many of these."""
    unknown: Literal["first class", "none"] = "first class"
    """What a Gaussian without a feature predicts. The script takes the argmax of zeros, which is the first class, wall."""
    assign: Literal["index", "nearest"] = "index"
    """"nearest" gives a vertex the class and the opacity of its nearest Gaussian, for scenes that were densified."""
    level: int = 0
    """Of a method with several."""

    def __post_init__(self) -> None:
        check_choice("classes", self.classes, COUNTS)
        check_range("least_opacity", self.least_opacity, 0, 1)
        check_choice("unknown", self.unknown, ("first class", "none"))
        check_choice("assign", self.assign, ("index", "nearest"))

    def score(self, method: Method, truth: PointTruth, views: Sequence[View], encode: Encode) -> Report:
        """Compare the classes of Gaussians with those of vertices.

        Args:
            method: with Gaussians.
            truth: the vertices of the mesh, with NYU40 ids.
            views: not used.
            encode: the teacher's text encoder.

        Raises:
            TypeError: if the method has no Gaussians, or `encode` is missing.
            ValueError: if there are more or fewer Gaussians than vertices, the labels are not NYU40's, or no vertex is scored.
        """
        ids, names = scannet_classes(self.classes)
        gaussians, predicted = predict_classes(method, names, encode, level=self.level, unknown=self.unknown)
        opacities, target = gaussians.opacities.detach().cpu(), scannet_labels(truth, ids, names)
        predicted = predicted.cpu()
        if self.assign == "nearest":
            tree = cKDTree(gaussians.means.detach().cpu().double().numpy())
            index = torch.from_numpy(tree.query(truth.points.cpu().double().numpy() - gaussians.origin, workers=-1)[1])
            opacities, predicted = opacities[index], predicted[index]
        elif len(gaussians) != len(target):
            raise ValueError(
                f"method: expected {len(target)} Gaussians (one at each vertex of truth.points), got {len(gaussians)}; "
                "freeze the positions, or use scannet-volume/1"
            )
        target[opacities < self.least_opacity] = -1
        if not bool((target >= 0).any()):
            raise ValueError(
                f"method: expected Gaussians of an opacity of at least {self.least_opacity:g} at some labelled vertex, got "
                "none; lower least_opacity, or score other Gaussians"
            )
        accuracy = float((predicted == target)[target >= 0].double().mean())
        return report_classes(self, method, names, class_scores(predicted, target, self.classes), accuracy)
