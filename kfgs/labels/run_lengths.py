"""COCO's run lengths of a mask, as annotation programs and Segment Anything write them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def decode_rle(segmentation: dict[str, Any]) -> Tensor:  # [H, W] bool
    """A mask from COCO's run lengths: `{"size": [H, W], "counts": ...}`, zeros first, column by column.

    Args:
        segmentation: `counts` is a list of lengths, or the text that COCO's tools compress it to.

    Raises:
        ValueError: if the lengths do not add up to the size.

    Example:
        >>> decode_rle({"size": [2, 2], "counts": [1, 2, 1]}).int().tolist()
        [[0, 1], [1, 0]]
    """
    from pycocotools import mask as coco

    size, counts = segmentation.get("size"), segmentation.get("counts")
    if not (isinstance(size, list) and len(size) == 2 and all(type(side) is int and 0 < side < 2**16 for side in size)):
        raise ValueError(f"size: expected [height, width], got {size!r:.80}")
    try:
        runs = segmentation
        if not isinstance(counts, str):
            if sum(counts) != size[0] * size[1]:  # type: ignore[arg-type]
                raise ValueError("they do not")
            runs = coco.frPyObjects(segmentation, *size)
        return torch.from_numpy(coco.decode(runs)).bool()
    except Exception as error:  # pycocotools raises bare exceptions
        raise ValueError(
            f"counts: expected lengths of runs that add up to {size[0]} x {size[1]}, got {counts!r:.80} ({error})"
        ) from error
