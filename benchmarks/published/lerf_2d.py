"""LangSplat's scores on LERF-OVS in 2-D: masks from relevancy, and whether its maximum lies in a box."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

from torch import Tensor

from kfgs._check import check_choice
from kfgs.evaluation.method import Method, View, annotated, check_level
from kfgs.evaluation.report import Report, Row, make_report, mean
from kfgs.evaluation.texts import Encode, encode_unit
from kfgs.labels.scores import CANONICAL, TEMPERATURE

from .mask_truth import MaskTruth
from .relevancy import (
    FILTERS,
    Filter,
    check_relevancy,
    clean_mask,
    fill_unknown,
    lerf_relevancy,
    mask_iou,
    smooth_relevancy,
    stretch,
)
from .truth.find import open_masks


class Activated(NamedTuple):
    """A text's masks in one view, one for each level."""

    masks: Tensor  # [levels, H, W] bool
    chosen: int  # the level with the largest blended relevancy


def activate(
    relevancy: Tensor,  # [levels, H, W]
    threshold: float = 0.4,
    filter: Filter = "langsplat",
    smoothed: Tensor | None = None,  # [levels, H, W]
) -> Activated:
    """Masks of a text as LangSplat makes them (`activate_stream`), and the level that it chooses.

    The relevancy is blended half and half with its box mean. It is stretched by its minimum and maximum in each level, cut
    at `threshold`, and cleaned by a 7 x 7 majority. The level is chosen by the maximum before stretching; a tie goes to
    the first. `smoothed` is the box mean, if it is known already.
    """
    blended = 0.5 * ((smooth_relevancy(relevancy, filter) if smoothed is None else smoothed) + relevancy)
    masks = clean_mask(stretch(blended) > threshold, filter)
    return Activated(masks, int(blended.amax((-2, -1)).argmax()))


def localise(
    smoothed: Tensor,  # [levels, H, W] `smooth_relevancy` of a text
    boxes: Tensor,  # [B, 4] x1, y1, x2, y2 in pixels
) -> bool:
    """Whether the largest smoothed relevancy lies in one of the boxes (`lerf_localization`).

    Of all levels the one with the largest smoothed value counts, and all pixels that attain it; one inside a box (its edges
    included) is enough.
    """
    level = smoothed[int(smoothed.amax((-2, -1)).argmax())]
    y, x = (level == level.max()).nonzero().T[:, :, None]  # [n, 1] each
    x1, y1, x2, y2 = boxes.to(smoothed).T  # [B] each
    return bool(((x >= x1) & (x <= x2) & (y >= y1) & (y <= y2)).any())


@dataclass(frozen=True)
class LerfOvs2D:
    """LangSplat's `eval/evaluate_iou_loc.py`: each text that is annotated in a frame is looked for in that frame.

    The evaluated frames are training views in LangSplat, LangSplatV2 and GAGS; Occam's LGS and VALA hold them out. Say which.
    Pixels without an answer count as the least relevant ones of their map; a map without any answer hits no box.
    """

    name: ClassVar[str] = "lerf-ovs-2d/1"
    about: ClassVar[str] = (
        "LERF-OVS in 2-D as LangSplat scores it: mean IoU of masks of relevancy over all (frame, text) pairs of the scene; "
        "localisation = share of the pairs whose most relevant pixel lies in a box"
    )
    open = staticmethod(open_masks)

    level: Literal["chosen", "oracle"] | int = "chosen"
    """Of a method with several maps. "chosen": the one with the most relevant pixel, as published. "oracle": the best IoU of
    any level, which nobody can know; do not report it as the result. A number: always this one."""
    threshold: float = 0.4
    """A pixel belongs to a text above it (`--mask_thresh`), after stretching. VALA's paper says 0.5."""
    filter: Filter = "langsplat"
    """"langsplat": 30 x 30 mean with OpenCV's offsets, majority that leaves out the last row and column. "langsplatv2": average
    pooling of 29 and 7."""
    scale: float = TEMPERATURE
    """Of the cosines in the relevancy."""
    negatives: tuple[str, ...] = CANONICAL
    """What texts are compared with."""

    def __post_init__(self) -> None:
        check_choice("filter", self.filter, FILTERS)
        check_relevancy(self.scale, self.negatives, self.threshold)
        if isinstance(self.level, str):
            check_choice("level", self.level, ("chosen", "oracle"))

    def score(self, method: Method, truth: MaskTruth, views: Sequence[View], encode: Encode) -> Report:
        """Look for the texts of each annotated frame.

        Args:
            method: what is scored.
            truth: masks, and boxes for the localisation; a text without boxes is not localised.
            views: of the annotated frames (others are ignored), of the size of the masks.
            encode: the teacher's text encoder.

        Raises:
            ValueError: if a frame has no view, or a mask has another size than its view.
        """
        check_level(method, self.level)
        rows: list[Row] = []
        for view in annotated(views, truth.frames):
            asked = truth.frames[view.stem]
            for text, found in relevancies(method, view, tuple(asked), encode, self.negatives, self.scale):
                rows.append({"view": view.stem, "text": text, **self._pair(found, *asked[text])})
        hits = (row["hit"] for row in rows if row["hit"] is not None)
        scores = {"mIoU": mean(row["IoU"] for row in rows), "localisation": mean(hits)}
        return make_report(self, method.name, scores, rows)

    def _pair(self, relevancy: Tensor, mask: Tensor, boxes: Tensor | None) -> Row:
        fixed = isinstance(self.level, int)
        seen = relevancy[[self.level]] if fixed else relevancy
        smoothed = smooth_relevancy(seen, self.filter)
        masks, level = activate(seen, self.threshold, self.filter, smoothed)
        ious = [mask_iou(one, mask) for one in masks]
        if self.level == "oracle":
            level = ious.index(max(ious))
        known = bool(
            (seen > 0).any()
        )  # relevancy is positive; unknown pixels of an unknown map are 0, and all of them its largest
        hit = None if boxes is None or len(boxes) == 0 else known and localise(smoothed, boxes)
        return {"level": self.level if fixed else level, "IoU": ious[level], "hit": hit}


def relevancies(
    method: Method, view: View, texts: Sequence[str], encode: Encode, negatives: Sequence[str], scale: float
) -> Iterator[tuple[str, Tensor]]:
    """LERF's relevancy of some texts in a view, [levels, H, W], one by one; unknown pixels have the least value of their map."""
    cosines = method.cosines(view, encode_unit(encode, [*texts, *negatives]))
    worst = cosines[..., len(texts) :].amax(-1, keepdim=True)
    for i, text in enumerate(texts):
        yield text, fill_unknown(lerf_relevancy(cosines[..., i : i + 1], worst, scale)[..., 0])
