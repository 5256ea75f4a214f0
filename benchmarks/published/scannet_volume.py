"""VALA's volume-aware score on ScanNet, for Gaussians that were moved and densified."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from scipy.spatial import cKDTree
from torch import Tensor

from kfgs._check import ORIGIN, check_choice, check_range, check_whole
from kfgs._origin import recounted
from kfgs.evaluation.method import Method, View
from kfgs.evaluation.report import Report
from kfgs.evaluation.texts import Encode
from kfgs.evaluation.truth import PointTruth
from kfgs.gaussians import Gaussians

from .scannet_points import (
    COUNTS,
    class_scores,
    predict_classes,
    report_classes,
    scannet_classes,
    scannet_labels,
)
from .truth.find import open_points

Vote = Literal["near", "far"]
VOTES = ("near", "far")
PAIRS = 500_000  # of a Gaussian and a vertex at once: 80 MB


def significance(gaussians: Gaussians) -> Tensor:  # [N] float64
    """What a Gaussian counts: the product of its scales and its opacity."""
    cloud = gaussians.detach().to("cpu", torch.float64)
    return cloud.scales.prod(1) * cloud.opacities


def gaussian_truth(
    gaussians: Gaussians,
    points: Tensor,  # [P, 3]
    labels: Tensor,  # [P] int64, -1 = none
    *,
    nearest: int = 1000,
    radius: float = 5.0,
    balanced: bool = True,
    vote: Vote = "near",
) -> Tensor:  # [N] int64, -1 = none
    """A class for each Gaussian, from the labelled points around it.

    Its candidates are the `nearest` labelled points within `radius` times its largest scale. Each votes for its class with
    exp(-d^2 / 2), d being the Mahalanobis distance; a class's sum is divided by the number of its candidates. The class with
    the largest result wins, a tie goes to the lowest. Without a candidate the class is -1.

    Args:
        gaussians: geometry only.
        points: vertices of the mesh.
        labels: class indices. Points with -1 are neither candidates nor counted among the `nearest`: our reading, protocols.md
            d2 does not say what VALA does with them.
        nearest: most candidates.
        radius: in largest scales.
        balanced: False leaves the division out, so that frequent classes win.
        vote: "far" sums the distances d themselves: Dr.Splat's Eq. 8, among the same candidates.
    """
    cloud = gaussians.detach().to("cpu", torch.float64)
    known = labels.cpu() >= 0
    places = recounted(points.detach().cpu().double(), ORIGIN, cloud.origin)[known]
    classes = labels.cpu()[known]
    found = torch.full((len(cloud),), -1, dtype=torch.int64)
    if len(places) == 0 or len(cloud) == 0:
        return found
    C, tree = int(classes.max()) + 1, cKDTree(places.numpy())
    reach = radius * cloud.scales.amax(1)
    around = tree.query_ball_point(cloud.means.numpy(), reach.numpy(), return_length=True, workers=-1)
    count = torch.from_numpy(around).clamp_max(nearest)
    whitening = quaternion_to_rotation_matrix(cloud.quats) / cloud.scales.clamp_min(1e-12)[:, None]  # R S^-1
    for rows in _alike(count):
        k = range(1, int(count[rows[-1]]) + 1)
        _, index = tree.query(cloud.means[rows].numpy(), k=k, workers=-1)
        inside = torch.arange(len(k)) < count[rows, None]  # [n, k]: the nearest come first
        owner, column = inside.nonzero().T
        which = torch.from_numpy(index)[owner, column]
        offsets = (places[which] - cloud.means[rows][owner])[:, None] @ whitening[rows][owner]  # [m, 1, 3]
        squares = offsets.square().sum((1, 2))
        # The nearest point's square is subtracted: it scales all votes of a Gaussian alike. A flat Gaussian's would all be 0.
        least = torch.full((len(rows),), torch.inf, dtype=torch.float64).scatter_reduce(0, owner, squares, "amin")
        votes = (-0.5 * (squares - least[owner])).exp() if vote == "near" else squares.sqrt()
        cell = owner * C + classes[which]
        sums = torch.zeros(len(rows) * C, dtype=torch.float64).index_add_(0, cell, votes)
        members = torch.bincount(cell, minlength=len(rows) * C)
        score = (sums / members.clamp_min(1) if balanced else sums).masked_fill(members == 0, -1).view(-1, C)
        found[rows] = score.argmax(1)
    return found


def _alike(count: Tensor) -> Iterator[Tensor]:  # [N] -> [n] int64 each
    """The Gaussians with candidates, those of like number together, in parts of at most `PAIRS` pairs."""
    order = count.argsort()
    order = order[count[order] > 0]
    while len(order):
        most = count[order[: max(1, PAIRS // int(count[order[0]]))]]
        fit = max(1, int((torch.arange(1, len(most) + 1) * most <= PAIRS).sum()))  # pairs grow along the order
        yield order[:fit]
        order = order[fit:]


@dataclass(frozen=True)
class ScanNetVolume:
    """VALA's `eval/evaluator3D.py`: Gaussians get a true class from the vertices around them, and count by their volume.

    Gaussians without a labelled vertex nearby are not scored. Vertices of none of the classes do not vote, and a Gaussian next
    to them takes the class of others in reach: that is our reading of VALA.

    Dr.Splat's own rule (its Eq. 8: the largest *sum of distances*) favours far and frequent classes: `vote="far"` with
    `balanced=False`. Which vertices it sums over is not settled by protocols.md d2. Here they are VALA's candidates, so the
    figures that Dr.Splat published are not to be expected.
    """

    name: ClassVar[str] = "scannet-volume/1"
    about: ClassVar[str] = (
        "ScanNet as VALA scores it: each Gaussian's true class is voted by the labelled vertices around it, weighted by "
        "exp(-d^2 / 2) and balanced by class; Gaussians count by scales x opacity; mIoU and mAcc over the classes that occur"
    )
    open = staticmethod(open_points)

    classes: int = 19
    """19, 15 or 10 classes of NYU40, by bare names."""
    nearest: int = 1000
    """Most vertices that vote for a Gaussian."""
    radius: float = 5.0
    """Vertices vote within this many times the Gaussian's largest scale."""
    balanced: bool = True
    """Whether a class's votes are divided by its number of candidates."""
    vote: Vote = "near"
    """How a vertex at Mahalanobis distance d votes: "near" with exp(-d^2 / 2) (VALA), "far" with d (Dr.Splat's Eq. 8)."""
    unknown: Literal["first class", "none"] = "none"
    """What a Gaussian without a feature predicts: nothing, which is wrong, or the first class."""
    level: int = 0
    """Of a method with several."""

    def __post_init__(self) -> None:
        check_choice("classes", self.classes, COUNTS)
        check_whole("nearest", self.nearest, 1)
        check_range("radius", self.radius, 0, closed=(False, False))
        check_choice("vote", self.vote, VOTES)
        check_choice("unknown", self.unknown, ("first class", "none"))

    def score(self, method: Method, truth: PointTruth, views: Sequence[View], encode: Encode) -> Report:
        """Compare the classes of Gaussians with those of the vertices around them.

        Args:
            method: with Gaussians, at any place.
            truth: the vertices of the mesh, with NYU40 ids.
            views: not used.
            encode: the teacher's text encoder.

        Raises:
            TypeError: if the method has no Gaussians, or `encode` is missing.
            ValueError: if the labels are not NYU40's, or no Gaussian has a labelled vertex nearby.
        """
        ids, names = scannet_classes(self.classes)
        gaussians, predicted = predict_classes(method, names, encode, level=self.level, unknown=self.unknown)
        target = gaussian_truth(
            gaussians,
            truth.points,
            scannet_labels(truth, ids, names),
            nearest=self.nearest,
            radius=self.radius,
            balanced=self.balanced,
            vote=self.vote,
        )
        if not bool((target >= 0).any()):
            raise ValueError(
                f"method: expected Gaussians with a labelled vertex within {self.radius:g} scales, got none among "
                f"{len(target)}; are they and the mesh in one frame?"
            )
        amount, predicted = significance(gaussians), predicted.cpu()
        found = class_scores(predicted, target, self.classes, amount)
        total = float(amount[target >= 0].sum())
        right = float(amount[(target >= 0) & (predicted == target)].sum())
        return report_classes(self, method, names, found, right / total if total > 0 else float("nan"))
