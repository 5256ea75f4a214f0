"""SceneSplat-Bench: points of a scene take the majority of their nearest Gaussians, in one confusion matrix."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kfgs._check import ORIGIN, check_choice, check_whole
from kfgs._origin import recounted
from kfgs.evaluation.method import Method, View, best_labels, check_level
from kfgs.evaluation.report import Report, Row, make_report, mean
from kfgs.evaluation.texts import Encode, encode_unit
from kfgs.evaluation.truth import VOID_NAMES, PointTruth, name_key
from kfgs.metrics import ConfusionMatrix
from kfgs.scenes import Scene
from kfgs.scenes.files import some

from .class_lists import load_classes
from .truth.find import open_points

BENCHMARKS = ("scannet20", "scannet200", "scannetpp100", "matterport21", "holicity4")
CHUNK = 16_384  # points looked up at once: with 200 classes their counts take 26 MB


def vote_nearest(
    points: Tensor,  # [P, 3]
    means: Tensor,  # [N, 3]
    labels: Tensor,  # [N] int64, -1 = none
    neighbours: int = 25,
) -> Tensor:  # [P] int64, -1 = none
    """The most frequent label among the nearest Gaussians of each point. "None" votes too; a tie goes to the lowest label."""
    places, centres = (x.detach().cpu().double().numpy() for x in (points, means))
    found = torch.full((len(places),), -1, dtype=torch.int64)
    if len(centres) == 0:
        return found
    tree, labels = cKDTree(centres), labels.cpu()
    C = int(labels.max()) + 1
    voting = labels.where(labels >= 0, C)  # "none" comes last, so that it loses a tie
    count = range(1, min(neighbours, len(centres)) + 1)
    for start in range(0, len(places), CHUNK):
        index = torch.from_numpy(tree.query(places[start : start + CHUNK], k=count, workers=-1)[1])
        votes = torch.zeros(len(index), C + 1, dtype=torch.int32)
        votes.scatter_add_(1, voting[index], torch.ones_like(index, dtype=torch.int32))
        best = votes.argmax(1)
        found[start : start + CHUNK] = best.masked_fill(best == C, -1)
    return found


def vote_instances(labels: Tensor, instances: Tensor) -> Tensor:  # [P], [P] int64 -> [P] int64
    """Give all points of an instance their most frequent label (the lowest of a tie); points of no instance (-1) keep theirs."""
    labels = labels.clone()
    for instance in instances[instances >= 0].unique():
        inside = instances == instance
        values, counts = labels[inside].unique(return_counts=True)
        labels[inside] = values[counts == counts.max()].min()
    return labels


@dataclass(frozen=True)
class SceneSplatBench:
    """SceneSplat-Bench's `open_vocab_seg_*.py`: foreground mIoU over the points of many scenes.

    `score` takes one scene, `score_scenes` those of a table, which are pooled in one confusion matrix. A scene's labels are
    matched with the benchmark's classes by name (`match_names`); the report's notes count the points of other names, which
    are not scored. ScanNet++'s several labels of a point are not supported: the first counts.
    """

    name: ClassVar[str] = "scenesplat-fmiou/1"
    about: ClassVar[str] = (
        "SceneSplat-Bench: a Gaussian takes its most similar class, a point the majority of its 25 nearest Gaussians; one "
        "confusion matrix over all scenes, no prediction is a miss; f-mIoU and f-mAcc leave out wall, floor and ceiling; means "
        "over the classes that the truth has"
    )

    benchmark: Literal["scannet20", "scannet200", "scannetpp100", "matterport21", "holicity4"] = "scannet20"
    """Which classes, prompts, and classes that are no foreground (`load_classes("scenesplat")`)."""
    template: str = "this is a {}"
    """What is asked for a class; HoliCity has six prompts of its own."""
    neighbours: int = 25
    """Gaussians that vote for a point."""
    ignored: tuple[str, ...] = ()
    """Names of the truth that are no class and are not scored. Without need where the truth names all classes besides."""
    drop_unknown: bool | None = None
    """Whether Gaussians without a feature are left out of the vote; else they vote for "none". None: as published, which is
    True for scannetpp100 and False for the others."""
    within_instances: bool = False
    """Take the majority inside each *true* instance, as `enable_clustering` in the script for Occam's LGS. It inflates."""
    least_cosine: float | None = None
    """A Gaussian whose best cosine is lower has no label. For SigLIP's sigmoid pass the cosine where its logit is 0."""
    level: int = 0
    """Of a method with several."""

    def open(
        self, scene: Scene, folder: Path, truth: Path | None = None, split: str | None = None
    ) -> tuple[PointTruth, list[View]]:
        """The labelled points of the scene, with the classes of the benchmark; see `open_points`."""
        return open_points(scene, folder, truth, split, self.benchmark)

    def __post_init__(self) -> None:
        check_choice("benchmark", self.benchmark, BENCHMARKS)
        check_whole("neighbours", self.neighbours, 1)
        if "{}" not in self.template:
            raise ValueError(f"template: expected a text with {{}} where the class goes, got {self.template!r}")

    def score(self, method: Method, truth: PointTruth, views: Sequence[View], encode: Encode) -> Report:
        """Score one scene; see `score_scenes`. `views` are not used."""
        return self.score_scenes([(method, truth)], encode)

    def score_scenes(self, scenes: Iterable[tuple[Method, PointTruth]], encode: Encode) -> Report:
        """Score a method on several scenes, in one confusion matrix.

        Args:
            scenes: a method with Gaussians and the labelled points of its scene, one scene at a time.
            encode: the teacher's text encoder.

        Raises:
            TypeError: if a method has no Gaussians.
            ValueError: if there is no scene, points have a name that may be a class in another spelling, instances are
                missing, or no point has a class.
        """
        lists = load_classes("scenesplat")[self.benchmark]
        classes: list[str] = lists["classes"]
        prompts = lists.get("prompts") or [[self.template.replace("{}", name), i] for i, name in enumerate(classes)]
        text = encode_unit(encode, [prompt for prompt, _ in prompts])
        meant = torch.tensor([index for _, index in prompts])
        pooled, name, count, left_out = ConfusionMatrix(len(classes)), "", 0, Counter[str]()
        for method, truth in scenes:
            target = match_names(truth, classes, self.ignored)
            pooled.update(self._predict(method, truth, text, meant), target.labels)
            left_out.update(target.left_out)
            name, count = method.name, count + 1
        if count == 0:
            raise ValueError("scenes: expected at least one, got none; pass pairs of a method and its truth")
        if int(pooled.matrix.sum() + pooled.misses.sum()) == 0:
            raise ValueError(
                f"truth: expected points of some class of {self.benchmark}, got none in {count} scenes; are these its labels?"
            )
        return self._report(pooled, lists, name, left_out)

    def _predict(self, method: Method, truth: PointTruth, text: Tensor, meant: Tensor) -> Tensor:  # [P] int64
        if method.gaussians is None:
            raise TypeError(
                f"method: expected one with Gaussians, got {method.name!r} without; use a protocol of views"
            )
        check_level(method, self.level)
        cosines = method.gaussian_cosines(text)[self.level].cpu()
        labels = best_labels(cosines)
        if self.least_cosine is not None:
            labels = labels.masked_fill(cosines.nan_to_num(-2.0).amax(-1) < self.least_cosine, -1)
        labels = meant[labels.clamp_min(0)].where(labels >= 0, -1)
        means = method.gaussians.means.cpu()
        if self._drops:
            means, labels = means[labels >= 0], labels[labels >= 0]
        points = recounted(truth.points, ORIGIN, method.gaussians.origin)
        found = vote_nearest(points, means, labels, self.neighbours)
        if not self.within_instances:
            return found
        if truth.instances is None:
            raise ValueError("truth: expected instances for within_instances, got None; leave the option out")
        return vote_instances(found, truth.instances.cpu())

    @property
    def _drops(self) -> bool:
        return self.benchmark == "scannetpp100" if self.drop_unknown is None else self.drop_unknown

    def _report(
        self, pooled: ConfusionMatrix, lists: Mapping[str, Any], method: str, left_out: Mapping[str, int]
    ) -> Report:
        classes, dropped = lists["classes"], lists["dropped"]
        counts = pooled.matrix.double()
        true, hits = counts.sum(1) + pooled.misses, counts.diagonal()
        iou, recall = hits / (true + counts.sum(0) - hits), hits / true
        rows: list[Row] = [
            {"class": name, "IoU": float(iou[i]), "recall": float(recall[i]), "foreground": name not in dropped}
            for i, name in enumerate(classes)
            if true[i] > 0
        ]
        front = [row for row in rows if row["foreground"]]
        means: dict[str, Any] = {
            f"{prefix}{score}": mean(row[key] for row in some)
            for prefix, some in (("f-", front), ("", rows))
            for score, key in (("mIoU", "IoU"), ("mAcc", "recall"))
        }
        notes = [f"Gaussians without a feature {'are left out of the vote' if self._drops else 'vote for none'}"]
        if left_out:
            names = ", ".join(f"{name} ({count} points)" for name, count in left_out.items())
            notes.append(f"not scored, no class of {self.benchmark}: {names}")
        return make_report(self, method, means | {"accuracy": pooled.accuracy()}, rows, notes)


class Matched(NamedTuple):
    """Points with the classes of a protocol."""

    labels: Tensor  # [P] int64, -1 = not scored
    left_out: dict[str, int]  # points of each name of the truth that is no class


def match_names(truth: PointTruth, classes: Sequence[str], ignored: Sequence[str] = ()) -> Matched:
    """The labels of points as indices into some classes, by name; -1 for all others.

    Names are compared by `name_key`. A name that is no class may be one in another spelling. It is left out if nothing can
    be lost by that: the truth names all classes besides (ScanNet's 40 names have the 20 of the benchmark), the name means
    "no class" (`VOID_NAMES`), or it is in `ignored`.

    Args:
        truth: labelled points; a label without a name is unlabelled.
        classes: what labels are indices of.
        ignored: names of the truth that are not scored.

    Raises:
        ValueError: if no name of the truth is a class, an ignored one is, or points have a name that may be a class.
    """
    keys = {name_key(name): i for i, name in reversed(list(enumerate(classes)))}
    if wrong := [name for name in ignored if name_key(name) in keys]:
        raise ValueError(
            f"ignored: expected names that are no classes of the protocol, got {some(wrong)}; leave them out"
        )
    ids = {
        label: classes.index(name) if name in classes else keys[name_key(name)]
        for label, name in truth.names.items()
        if name_key(name) in keys
    }
    if not ids:
        got = ", ".join(list(truth.names.values())[:3])
        raise ValueError(
            f"truth: expected names such as {', '.join(classes[:3])} (of the benchmark), got {got or 'none'}"
        )
    labels = truth.labels.cpu()
    found, left_out = torch.full_like(labels, -1), dict[str, int]()
    for label, count in zip(*(column.tolist() for column in labels.unique(return_counts=True)), strict=True):
        if label in ids:
            found[labels == label] = ids[label]
        elif label in truth.names:
            name = truth.names[label]
            left_out[name] = left_out.get(name, 0) + count
    known = {name_key(name) for name in (*VOID_NAMES, *ignored)}
    strange = [name for name in left_out if name_key(name) not in known]
    nameless = [name for i, name in enumerate(classes) if i not in ids.values()]
    if strange and nameless:
        raise ValueError(
            f"truth: expected names of {len(classes)} classes, {some(nameless, 3)} among them, got points named "
            f"{', '.join(strange)}; correct names that are a class in another spelling, and give the others as "
            f"ignored={','.join(strange)}"
        )
    return Matched(found, left_out)
