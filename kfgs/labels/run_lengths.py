"""COCO's run lengths of a mask, as annotation programs and Segment Anything write them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def decode_rle(segmentation: dict[str, Any]) -> Tensor:  # [H, W] bool
    """A mask from `{"size": [H, W], "counts": ...}`: lengths of runs, zeros first, column by column; or COCO's packed text.

    A ValueError if the lengths do not add up to the size.

    Example:
        >>> decode_rle({"size": [2, 2], "counts": [1, 2, 1]}).int().tolist()
        [[0, 1], [1, 0]]
    """
    from pycocotools import mask as coco

    size, counts = segmentation.get("size"), segmentation.get("counts")
    try:
        height, width = (int(side) for side in size)  # type: ignore[union-attr]
        if not (0 < height < 2**16 and 0 < width < 2**16):
            raise ValueError("sides of 1 to 65,535 pixels")
        if not isinstance(counts, str):
            if sum(counts) != height * width:  # type: ignore[arg-type]
                raise ValueError("another sum")
            segmentation = coco.frPyObjects(segmentation, height, width)
        return torch.from_numpy(coco.decode(segmentation)).bool()
    except Exception as error:  # pycocotools raises bare exceptions
        raise ValueError(
            f"counts: expected runs that add up to the size [H, W], got {counts!r:.80} for {size!r:.80} ({error})"
        ) from error
