"""The three scores that papers call "3D-OVS". They are not comparable, so each has a name of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from kfgs._check import check_choice, check_range, check_whole
from kfgs.cameras.resample import resize_labels
from kfgs.evaluation.method import Method, View, annotated, check_level, label_view
from kfgs.evaluation.report import Report, Row, make_report, mean
from kfgs.evaluation.texts import Encode, encode_unit
from kfgs.labels.scores import CANONICAL, TEMPERATURE

from .lerf_2d import activate, relevancies
from .mask_truth import MaskTruth
from .relevancy import FILTERS, Filter, check_relevancy, clean_mask, mask_iou
from .stable_threshold import stable_mask
from .truth.find import open_masks


def mask_at(mask: Tensor, view: View) -> Tensor:  # [H, W] bool
    """A mask in the size of the view, by nearest neighbour, on the CPU."""
    return resize_labels(mask.long().cpu(), view.camera.size).bool()


def one_hot_accuracy(
    labels: Tensor,  # [H, W] int64, -1 = none
    masks: Sequence[Tensor],  # C masks [H, W] bool
) -> float:
    """The share of pixels whose whole one-hot row is right: one mask holds the pixel, and it is that of its label.

    A pixel in no mask is right only if nothing is predicted there, and one in two masks never is.

    Example:
        >>> masks = [torch.tensor([[True, True, False]]), torch.tensor([[False, True, False]])]
        >>> round(one_hot_accuracy(torch.tensor([[0, 0, -1]]), masks), 3)
        0.667
    """
    truth = torch.stack(list(masks), dim=-1)
    predicted = labels[..., None] == torch.arange(len(masks))
    return float((truth == predicted).all(-1).double().mean())


@dataclass(frozen=True)
class OVS3DClosed:
    """3D-OVS's own `renderer.py`: a closed set, the scene's list of texts; each pixel takes its most similar one.

    IoU counts for the texts that have a mask in a view. A class without a pixel in truth and prediction has IoU 0, as in
    scikit-learn's Jaccard score.
    """

    name: ClassVar[str] = "3dovs-closed/1"
    about: ClassVar[str] = (
        "3D-OVS as its authors score it: each pixel takes the most similar text of the scene; mIoU = mean over views x texts; "
        "accuracy = share of pixels whose whole one-hot row is right"
    )
    open = staticmethod(open_masks)
    rule: ClassVar[str] = "nearest"
    """Every method takes the text with the largest cosine."""

    texts: tuple[str, ...] = ()
    """What pixels choose from. Empty: the scene's list (`MaskTruth.listed`, from `classes.txt`), or the texts that have a mask
    if there is no list. The report's note says which."""
    level: int = 0
    """Of a method with several."""

    def score(self, method: Method, truth: MaskTruth, views: Sequence[View], encode: Encode) -> Report:
        """Segment each annotated view into the scene's texts.

        Raises:
            ValueError: if a picture has no view, or `texts` lacks an annotated text.
        """
        asked = self.texts or truth.listed or truth.texts
        missing = [text for text in truth.texts if text not in asked]
        if missing:
            raise ValueError(f"texts: expected all annotated texts, got none of {', '.join(missing)}; add them")
        rows_of_texts = encode_unit(encode, asked)
        rows: list[Row] = []
        shares = []
        for view in annotated(views, truth.frames):
            labels = label_view(method, view, rows_of_texts, self.level).cpu()
            known = {text: mask_at(mask, view) for text, (mask, _) in truth.frames[view.stem].items()}
            nothing = torch.zeros(view.camera.size, dtype=torch.bool)
            for text, mask in known.items():
                rows.append({"view": view.stem, "text": text, "IoU": mask_iou(labels == asked.index(text), mask)})
            shares.append(one_hot_accuracy(labels, [known.get(text, nothing) for text in asked]))
        scores = {"mIoU": mean(row["IoU"] for row in rows), "accuracy": mean(shares)}
        origin = (
            "the option `texts`"
            if self.texts
            else "the scene's list"
            if truth.listed
            else "the masks: no list is known"
        )
        return make_report(self, method.name, scores, rows, [f"argmax over {len(asked)} texts of {origin}"])


@dataclass(frozen=True)
class OVS3DThreshold:
    """The score of LangSplat and its successors: an open set, each text by its relevancy above a threshold.

    Their scripts for 3D-OVS are not published. Filters, stretching, threshold and the choice of the level are those of
    LangSplat's script for LERF-OVS (`lerf-ovs-2d/1`); all are options.
    """

    name: ClassVar[str] = "3dovs-threshold/1"
    about: ClassVar[str] = (
        "3D-OVS as LangSplat's successors score it: masks of relevancy at a threshold, each text alone; mIoU = mean over "
        "(view, text) pairs; filters, threshold and choice of level are those of LangSplat's LERF-OVS script"
    )
    open = staticmethod(open_masks)

    threshold: float = 0.4
    """A pixel belongs to a text above it."""
    stretched: bool = True
    """Whether relevancy is smoothed, stretched by minimum and maximum, and its mask cleaned. False compares it as it is."""
    filter: Filter = "langsplat"
    """Of the smoothing and cleaning."""
    level: Literal["chosen"] | int = "chosen"
    """Of a method with several: the one with the most relevant pixel, or a fixed one."""
    scale: float = TEMPERATURE
    """Of the cosines in the relevancy."""
    negatives: tuple[str, ...] = CANONICAL
    """What texts are compared with."""

    def __post_init__(self) -> None:
        check_choice("filter", self.filter, FILTERS)
        check_relevancy(self.scale, self.negatives, self.threshold)
        if isinstance(self.level, str):
            check_choice("level", self.level, ("chosen",))

    def score(self, method: Method, truth: MaskTruth, views: Sequence[View], encode: Encode) -> Report:
        """Look for each text in each annotated view.

        Raises:
            ValueError: if a picture has no view.
        """
        check_level(method, self.level)
        rows: list[Row] = []
        for view in annotated(views, truth.frames):
            asked = truth.frames[view.stem]
            for text, found in relevancies(method, view, tuple(asked), encode, self.negatives, self.scale):
                seen = found if isinstance(self.level, str) else found[[self.level]]
                if self.stretched:
                    masks, level = activate(seen, self.threshold, self.filter)
                else:
                    masks, level = seen > self.threshold, int(seen.amax((-2, -1)).argmax())
                rows.append(
                    {
                        "view": view.stem,
                        "text": text,
                        "IoU": mask_iou(masks[level].cpu(), mask_at(asked[text].mask, view)),
                    }
                )
        return make_report(self, method.name, {"mIoU": mean(row["IoU"] for row in rows)}, rows)


@dataclass(frozen=True)
class OVS3DStability:
    """Occam's LGS's `eval/evaluate_iou_3dovs.py`: each text has a threshold of its own, where its mask hardly changes."""

    name: ClassVar[str] = "3dovs-stability/1"
    about: ClassVar[str] = (
        "3D-OVS as Occam's LGS scores it: the threshold of each text is the middle of the last run of thresholds at which "
        "mask and mean score are stable, at the level with the smallest slope; mIoU = mean over (view, text) pairs"
    )
    open = staticmethod(open_masks)

    steepest: float = 0.4
    """A threshold is stable if mean score and mask fraction change by less, per unit of threshold (`stability_thresh`)."""
    fractions: tuple[float, float] = (0.005, 0.9)
    """... and if the mask's share of the picture lies between these."""
    run: int = 5
    """Fewest neighbouring thresholds, of 0.01 each, that count as stable."""
    scale: float = TEMPERATURE
    """Of the cosines in the relevancy."""
    negatives: tuple[str, ...] = CANONICAL
    """What texts are compared with."""

    def __post_init__(self) -> None:
        check_range("steepest", self.steepest, 0, closed=(False, False))
        check_range("fractions (highest)", self.fractions[1], self.fractions[0], closed=(False, True))
        check_whole("run", self.run, 1)
        check_relevancy(self.scale, self.negatives)

    def score(self, method: Method, truth: MaskTruth, views: Sequence[View], encode: Encode) -> Report:
        """Look for each text in each annotated view.

        Raises:
            ValueError: if a picture has no view.
        """
        rows: list[Row] = []
        for view in annotated(views, truth.frames):
            asked = truth.frames[view.stem]
            for text, found in relevancies(method, view, tuple(asked), encode, self.negatives, self.scale):
                stable = stable_mask(found, steepest=self.steepest, fractions=self.fractions, run=self.run)
                iou = mask_iou(clean_mask(stable.mask, "langsplat").cpu(), mask_at(asked[text].mask, view))
                row = {
                    "view": view.stem,
                    "text": text,
                    "IoU": iou,
                    "level": stable.level,
                    "threshold": stable.threshold,
                }
                rows.append(row)
        return make_report(self, method.name, {"mIoU": mean(row["IoU"] for row in rows)}, rows)
