"""Ground truth of texts: the masks that each has in some pictures of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from kfgs._check import check_shapes


class MaskAndBoxes(NamedTuple):
    """Where one text is in a picture."""

    mask: Tensor  # [H, W] bool
    boxes: Tensor | None = None  # [B, 4] x1, y1, x2, y2 in pixels, one for each object


@dataclass(frozen=True, eq=False)
class MaskTruth:
    """Masks of texts in some pictures; those of one picture may overlap, and leave pixels without any."""

    frames: Mapping[str, Mapping[str, MaskAndBoxes]]
    """By the picture's stem, then by text. A text that a frame lacks is not asked there."""
    scene: str | None = None
    """The data set's name of the scene ("figurines"), where a protocol has a list of texts for it."""
    listed: tuple[str, ...] = ()
    """The data set's own list of the scene's texts (`classes.txt` of 3D-OVS), whether a picture has a mask of each or not."""

    def __post_init__(self) -> None:
        for stem, texts in self.frames.items():
            sizes = []
            for text, (mask, boxes) in texts.items():
                name = f"frames[{stem!r}][{text!r}]"
                check_shapes((f"{name}.mask", mask, "H W"), (f"{name}.boxes", boxes, "B 4"))
                sizes.append((f"{name}.mask", mask, "H W"))
            check_shapes(*sizes)

    @property
    def texts(self) -> tuple[str, ...]:
        """All texts that have a mask, in the order of their first appearance."""
        return tuple(dict.fromkeys(text for texts in self.frames.values() for text in texts))
