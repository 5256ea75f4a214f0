"""COCO's run lengths of a mask, as annotation programs and Segment Anything write them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def decode_rle(segmentation: dict[str, Any]) -> Tensor:  # [H, W] bool
    """A mask from `{"size": [H, W], "counts": ...}`: lengths of runs, zeros first, column by column; or COCO's packed text.

    Example:
        >>> decode_rle({"size": [2, 2], "counts": [1, 2, 1]}).int().tolist()
        [[0, 1], [1, 0]]
    """
    from pycocotools import mask as coco

    size, counts = segmentation.get("size"), segmentation.get("counts")
    try:
        height, width = size  # type: ignore[misc]
        if min(size) < 0 or height * width > 2**27 or (not isinstance(counts, str) and sum(counts) != height * width):  # type: ignore[arg-type]  # 2**27: as of a picture
            raise ValueError("another size")
        runs = segmentation if isinstance(counts, str) else coco.frPyObjects(segmentation, height, width)
        return torch.from_numpy(coco.decode(runs)).bool()
    except Exception as error:  # pycocotools raises bare exceptions
        raise ValueError(
            f"counts: expected runs that fill {size!r:.80} pixels, got {counts!r:.80} ({error})"
        ) from error
