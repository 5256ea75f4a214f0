"""OpenGaussian's score on LERF-OVS in 3-D: Gaussians are selected by a text, and only those are rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kfgs._check import check_choice, check_range, check_whole
from kfgs.cameras import Camera
from kfgs.evaluation.method import Method, View, annotated, best_labels, check_level
from kfgs.evaluation.report import Report, Row, make_report, mean
from kfgs.evaluation.texts import Encode, encode_unit
from kfgs.evaluation.truth import name_key
from kfgs.gaussians import Gaussians
from kfgs.labels.scores import CANONICAL, TEMPERATURE
from kfgs.splat import rasterize

from .class_lists import load_classes
from .mask_truth import MaskTruth
from .relevancy import check_relevancy, lerf_relevancy, mask_iou, stretch
from .truth.find import open_masks

ALWAYS = ("selection", "threshold", "silhouette")
"""Options that are printed with every score: they move it so much."""
RULES = ("argmax", "smoothed", "relevancy")


def silhouette(gaussians: Gaussians, selected: Tensor, camera: Camera, threshold: float = 0.7) -> Tensor:  # [H, W] bool
    """Where the selected Gaussians alone are more opaque than a threshold.

    Args:
        gaussians: only their geometry and opacity matter.
        selected: a mask [N].
        camera: without distortion.
        threshold: of the accumulated alpha; strict.
    """
    chosen = gaussians.select(selected)
    one = torch.ones(len(chosen), 1).to(chosen.means)
    with torch.no_grad():
        return rasterize(chosen.replace(features=one, sh=None), camera).alpha > threshold


def nearest_gaussians(means: Tensor, count: int = 10) -> Tensor:  # [N, 3] -> [N, count] int64
    """The Gaussians nearest to each centre, itself included; fewer columns if there are fewer Gaussians."""
    points = means.detach().cpu().double().numpy()
    index = cKDTree(points).query(points, k=range(1, min(count, len(points)) + 1), workers=-1)[1]
    return torch.from_numpy(index).to(means.device)


def share_above(ious: Sequence[float], threshold: float) -> float:
    """Acc@t: the share of IoUs above a threshold, strictly.

    Example:
        >>> share_above([0.25, 0.26], 0.25)
        0.5
    """
    return mean(value > threshold for value in ious)


@dataclass(frozen=True)
class LerfOvs3D:
    """OpenGaussian's `scripts/compute_lerf_iou.py`, with the selection rules of other methods as options.

    `LerfOvs3D()` is the rule of the LangSplat baseline in OpenGaussian's table: each Gaussian takes its most similar text.
    `LerfOvs3D.vala()` and `LerfOvs3D.dr_splat()` are those of VALA's scripts. The thresholds of selection and silhouette move
    the mIoU by many points, so the report always names both. OpenGaussian's own rule needs its clusters and is not here.
    """

    name: ClassVar[str] = "lerf-ovs-3d/1"
    about: ClassVar[str] = (
        "LERF-OVS in 3-D: Gaussians are selected by a text, only those are rendered, and the silhouette is compared with the "
        "mask; mean over (frame, text) pairs; Acc@t = share of the pairs with an IoU above t, strictly"
    )
    open = staticmethod(open_masks)

    selection: Literal["argmax", "smoothed", "relevancy"] = "argmax"
    """"argmax": each Gaussian belongs to the most similar text of the scene. "smoothed" (VALA): relevancy, averaged half and half
    with its 10 nearest Gaussians, stretched by minimum and maximum, above `threshold`. "relevancy" (Dr.Splat's demo):
    relevancy at or above `threshold`."""
    threshold: float = 0.6
    """Of the selection; VALA's script has 0.6 (its default is 0.4), Dr.Splat's demo 0.5. Argmax has none."""
    silhouette: float = 0.7
    """A pixel is covered above this alpha. VALA cuts 8-bit pictures at 10: 10 / 255."""
    texts: tuple[str, ...] = ()
    """What argmax chooses from. Empty: the published list of the scene (`load_classes("lerf_ovs")`) if the truth knows its
    scene, and the annotated texts. The report's note says which."""
    neighbours: int = 10
    """Nearest Gaussians of the smoothing, the Gaussian itself included."""
    level: Literal["chosen"] | int = "chosen"
    """Of a method with several: the one with the largest score of the text, or a fixed one. Each level has its own known
    Gaussians: neighbours, smoothing and stretching are among these."""
    scale: float = TEMPERATURE
    """Of the cosines in the relevancy."""
    negatives: tuple[str, ...] = CANONICAL
    """What texts are compared with, for the relevancy."""

    def __post_init__(self) -> None:
        check_choice("selection", self.selection, RULES)
        check_relevancy(self.scale, self.negatives, self.threshold)
        check_range("silhouette", self.silhouette, 0, 1)
        check_whole("neighbours", self.neighbours, 1)
        if isinstance(self.level, str):
            check_choice("level", self.level, ("chosen",))

    @classmethod
    def vala(cls) -> LerfOvs3D:
        """`eval/render_lerf_by_text_drsplat.py` as `scripts/eval_lerf_ovs_3d.sh` calls it."""
        return cls(selection="smoothed", threshold=0.6, silhouette=10 / 255)

    @classmethod
    def dr_splat(cls) -> LerfOvs3D:
        """Dr.Splat's demo, scored with VALA's silhouettes."""
        return cls(selection="relevancy", threshold=0.5, silhouette=10 / 255)

    def score(self, method: Method, truth: MaskTruth, views: Sequence[View], encode: Encode) -> Report:
        """Select by each text of the truth, and render.

        Raises:
            TypeError: if the method has no Gaussians.
            ValueError: if a frame has no view, a mask has another size than its view, or `texts` lacks an annotated text.
        """
        asked, note = self.competing(truth.texts, truth.scene) if self.selection == "argmax" else (truth.texts, "")
        selected = self.select(method, truth.texts, encode, asked)
        assert method.gaussians is not None
        rows: list[Row] = []
        for view in annotated(views, truth.frames):
            for text, (mask, _) in truth.frames[view.stem].items():
                seen = silhouette(method.gaussians, selected[text], view.camera, self.silhouette)
                count = int(selected[text].sum())
                rows.append({"view": view.stem, "text": text, "IoU": mask_iou(seen, mask), "Gaussians": count})
        ious = [row["IoU"] for row in rows]
        scores = {"mIoU": mean(ious), "Acc@0.25": share_above(ious, 0.25), "Acc@0.5": share_above(ious, 0.5)}
        report = make_report(self, method.name, scores, rows, [note] if note else [])
        return replace(report, changed=tuple(dict.fromkeys((*report.changed, *ALWAYS))))

    def competing(self, texts: Sequence[str], scene: str | None = None) -> tuple[tuple[str, ...], str]:
        """The texts that argmax chooses from, and in words where they are from.

        Args:
            texts: those that are annotated.
            scene: of LERF-OVS, whose published list also has texts that no annotated frame shows.

        Raises:
            ValueError: if `self.texts` lacks one of `texts`.
        """
        if self.texts:
            if missing := [text for text in texts if text not in self.texts]:
                raise ValueError(f"texts: expected all annotated texts, got none of {', '.join(missing)}; add them")
            return self.texts, f"argmax over the {len(self.texts)} texts of the option `texts`"
        published = load_classes("lerf_ovs")["texts"].get(scene, ())
        if not published:
            return tuple(
                texts
            ), f"argmax over the annotated texts ({len(texts)}): no published list of the scene is known"
        written = {name_key(text): text for text in texts}
        asked = tuple(written.get(name_key(text), text) for text in published)
        more = [text for text in texts if text not in asked]
        besides = f", and of the truth besides: {', '.join(more)}" if more else ""
        return (*asked, *more), f"argmax over the {len(asked)} published texts of {scene}{besides}"

    def select(
        self, method: Method, texts: Sequence[str], encode: Encode, asked: Sequence[str] | None = None
    ) -> dict[str, Tensor]:  # [N] bool each
        """The Gaussians of each text.

        Args:
            method: with Gaussians.
            texts: what is looked for.
            encode: the teacher's text encoder.
            asked: what argmax chooses from; None: what `competing` says of `texts` alone.

        Raises:
            TypeError: if the method has no Gaussians.
            ValueError: if `self.texts` or `asked` lacks one of `texts`.
        """
        if method.gaussians is None:
            raise TypeError(f"method: expected one with Gaussians, got {method.name!r} without; use lerf-ovs-2d/1")
        check_level(method, self.level)
        if self.selection == "argmax":
            return self._best(method, texts, encode, self.competing(texts)[0] if asked is None else asked)
        cosines = method.gaussian_cosines(encode_unit(encode, [*texts, *self.negatives]))
        scores = lerf_relevancy(cosines[..., : len(texts)], cosines[..., len(texts) :], self.scale)
        scores = self._levels(scores)  # [levels, N, K]
        known = ~scores.isnan().any(-1)  # [levels, N]: each level may know other Gaussians
        selected = {text: torch.zeros_like(known[0]) for text in texts}
        if not bool(known.any()):
            return selected
        if self.selection == "smoothed":
            scores = self._smooth(method.gaussians.means, scores, known)
        tops = scores.masked_fill(~known[..., None], -torch.inf).amax(1)  # [levels, K]
        for i, (text, level) in enumerate(zip(texts, tops.argmax(0).tolist(), strict=True)):
            score = scores[level, known[level], i]
            chosen = stretch(score, 1) > self.threshold if self.selection == "smoothed" else score >= self.threshold
            selected[text][known[level]] = chosen
        return selected

    def _smooth(self, means: Tensor, scores: Tensor, known: Tensor) -> Tensor:  # [levels, N, K]
        """Each level's relevancy, half and half with the mean of the nearest Gaussians that the level knows."""
        found = scores.clone()
        for level, mine in enumerate(known):
            if not bool(mine.any()):
                continue
            if level == 0 or not torch.equal(mine, known[level - 1]):
                near = nearest_gaussians(means[mine], self.neighbours)
            some = scores[level, mine]
            for i in range(some.shape[1]):  # one text at a time: [n, neighbours]
                found[level, mine, i] = 0.5 * (some[:, i] + some[near, i].mean(-1))
        return found

    def _best(
        self, method: Method, texts: Sequence[str], encode: Encode, asked: Sequence[str]
    ) -> dict[str, Tensor]:  # [N] bool each
        if missing := [text for text in texts if text not in asked]:
            raise ValueError(
                f"asked: expected all texts that are looked for, got none of {', '.join(missing)}; add them"
            )
        cosines = self._levels(method.gaussian_cosines(encode_unit(encode, asked)))
        labels = best_labels(cosines)  # [levels, N]
        if labels.shape[1] == 0:
            return {text: labels[0] == 0 for text in texts}
        selected = {}
        for text in texts:
            i = list(asked).index(text)
            mine = labels == i
            top = cosines[..., i].masked_fill(~mine, -torch.inf).amax(-1)
            selected[text] = mine[int(top.argmax())]
        return selected

    def _levels(self, values: Tensor) -> Tensor:  # [levels, ...]
        return values if isinstance(self.level, str) else values[[self.level]]
