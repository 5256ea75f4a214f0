"""The palette of every picture, 2-D and 3-D: label k always has colour k, and -1 is grey."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from .._check import as_array

UNLABELLED = (128, 128, 128)  # grey: label -1

# Okabe and Ito's seven colours without black. Each next colour is the farthest (CIE76) from all earlier ones, grey, black
# and white, for the worst of three kinds of eyes: normal, protanopia, deuteranopia (Machado 2009). Smallest distance among
# the first 20: 17; of 64: 9; of 256: 4. tests/oracles_palette.py computes this table.
_HEX = """
e69f00 56b4e9 009e73 f0e442 0072b2 d55e00 cc79a7 0000ff 781e00 a5f096 6969ff 3c3c5a 3c1ea5 3c4b3c 4bb45a a5d2b4
6996ff a5e1ff 4b783c 003c87 d2e169 2d3ce1 3c5ac3 b42d00 785a87 96d2d2 2dd287 96b4d2 695a69 d2f0c3 2d5a2d c3b44b
3c4bd2 9687c3 4b4b87 1e785a 87962d 0000d2 a569d2 f09669 a5a596 1e963c 0f4b4b a53ca5 69691e ff96ff b4d23c 69ffe1
1e3c69 5a2dff 697887 f05aff 782d1e a5e178 e196b4 3c3ca5 00965a a569a5 2d2dc3 3c5aff 00f0a5 96f0f0 d27878 69d278
965ae1 2d784b f0e15a f078e1 e10f3c a5ff00 690f87 0fd296 e1001e 4b4b78 87d2e1 f04b96 ffd2d2 2d0fc3 96ff87 e11e5a
5a4b69 ff5a3c a50f00 e1962d f087c3 960fb4 00d2ff a569e1 873c5a e11e96 ffa596 f04b69 960f4b 00a5d2 004b1e e1c369
a54b78 3c4be1 a51e2d 962dff d2874b 6996a5 f0b42d ffa5c3 69870f d21eb4 e1d200 f05ac3 2da5e1 0078c3 002de1 a5d24b
a50f3c 3cb44b 78d2f0 5a5ae1 78d25a 873cc3 b4a578 962da5 f0d2a5 2d3c78 78005a 5aa5ff a5f0ff d278b4 00f0d2 3cc3ff
3c8769 b48787 96a587 96a5a5 4bc33c 78690f 007878 87e187 2d2d96 b4b4a5 00872d 965ac3 2d1ef0 0f5a4b 00693c 870f5a
d28700 780078 e18787 2d3cc3 004b96 96d2a5 f02d5a 870f3c a5ff69 a5b469 2d875a 87ff78 e15a2d f02d78 c31e96 b478f0
2d6996 0f874b 96e1f0 a54bf0 e169d2 ff004b 5a5a0f 4b00b4 691e69 6978b4 a58796 690fb4 871e96 4b69d2 b40069 f00fb4
e13c87 b41eb4 4bf0c3 784b78 a55aa5 f0a578 78d2c3 00a53c 3c5a87 a55a2d ffe1b4 780f1e 698796 960fd2 f0875a 0000e1
780fa5 96ff96 1ee196 96f01e 4be169 a569ff f0d2b4 c3a5f0 c32dd2 873c2d 690fd2 a5a5c3 f096d2 ffa5e1 873cf0 96f087
e1d25a c33c4b 961e0f c387f0 78c3e1 e1a587 f0d2c3 a5e1e1 e1a5b4 00ffd2 c3e14b 8787e1 ff963c d287d2 5a0f96 ffe1e1
006969 4b3c2d 2d4b00 786996 96f078 780f4b 961e87 c36969 872d78 b4d2ff ff7878 ff5ab4 b42d3c 785aa5 69b4e1 a54bd2
e1b4f0 5a87c3 d2f0a5 2d3cf0 87a500 694b1e ffb4b4 69c3a5 5ac35a 4b96b4 6969f0 a5ff4b 8778f0 a53c5a a5e15a 5aa54b
"""
PALETTE = np.frombuffer(bytes.fromhex("".join(_HEX.split())), dtype=np.uint8).reshape(-1, 3)  # [256, 3], read-only


def palette(labels: Tensor | np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:  # [...] int -> [..., 3] uint8
    """The colour of each label, safe for colour-blind eyes; -1 is grey.

    Args:
        labels: class indices of any shape. From 256 on the colours repeat.

    Returns:
        RGB, 8 bit, one more axis than `labels`.

    Raises:
        TypeError: if the labels are not integers.
        ValueError: if one is below -1.

    Example:
        >>> import torch
        >>> palette(torch.tensor([0, -1])).tolist()
        [[230, 159, 0], [128, 128, 128]]
    """
    values = as_array(labels, "labels")
    if not np.issubdtype(values.dtype, np.integer):
        raise TypeError(f"labels: expected integers, got {values.dtype}; convert them first")
    values = values.astype(np.int64)
    if values.size and values.min() < -1:
        raise ValueError(f"labels: expected class indices or -1, got {values.min()}; map other codes to -1 first")
    return np.where((values < 0)[..., None], np.array(UNLABELLED, dtype=np.uint8), PALETTE[values % len(PALETTE)])
