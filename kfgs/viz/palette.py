"""The palette of every picture, 2-D and 3-D: a class has its colour, and -1 is grey."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any
from zlib import crc32

import numpy as np
from torch import Tensor

from .._check import as_array

UNLABELLED = (128, 128, 128)  # grey: label -1

# The first 20: found by search, so that any two of them and grey differ as much as possible (CIEDE2000), seen with normal
# eyes (21 at least), with protanopia and deuteranopia (9; Machado 2009), and half mixed with grey (12; 6). Each next colour is
# the farthest (CIE76) from all earlier ones, grey, black and white for the worst of these eyes. tests/oracles_palette.py
# measures the first and computes the others.
_HEX = """
f1ea0b 8000d7 6c3200 9be5ff ed6a31 0088ff eee1e4 ff22c1 573852 c2a2ff 766800 62a271 084682 1c5b33 f5a40a ad4f58
dceac8 f0989f 027280 00ff8f 2d2d96 0087b4 00c35a 69ff69 0000ff b42dd2 f096c3 5a692d 3c5aff 2da52d 002db4 ff875a
3c4ba5 3c5a87 78d287 781e1e 4b3c3c b4694b 87d22d 96c3f0 c378d2 00d2d2 784b5a 0f3cff c378a5 0069a5 7896ff 1e69d2
3c3c69 d2f0b4 b4d2c3 ff5a00 d2d278 e187a5 ffd25a d21e00 d27869 a55af0 4b3cb4 964b78 ffe14b 4ba5e1 f0a578 0000d2
787869 9678e1 ffe196 c3d2a5 966996 4b694b 5aa587 a50f1e 003c87 ffb4e1 5a965a d2c35a b4963c 783c69 004be1 b4b43c
c32da5 b4d2b4 c31e4b a5b487 780f69 3c00c3 b42dc3 a54b2d b4f0ff ff1e1e 96b4f0 1e2da5 a51ef0 78b4b4 963c3c 4b3cc3
e1e1d2 b4e100 96a5d2 e18796 872d4b b4964b c37896 690f78 692d96 5a0ff0 4b5a1e a5874b 96e14b a5e196 2d4b00 69ff78
2dc369 780f4b 4b6996 004b2d ffb43c 875a69 3c96c3 78781e 4b5ab4 2d4b1e 783c96 96c3b4 87c3a5 a5ff1e c34b3c 8796f0
96c300 968778 5ae1e1 3c87c3 009600 691e5a a5a50f 2d3c5a e15a2d 5a1ec3 c3a55a 2d69ff 2dffe1 ff1eb4 4b1ee1 3c69e1
2d78e1 c35a69 784b69 871e2d b4c396 78b4c3 3c3ca5 a5d2ff b469ff ff3c78 c3f0a5 2d785a d2e1b4 a5c3ff 783c78 ff78e1
4b4bb4 69d278 a5e169 87693c c3d2d2 781e78 b44b87 a569b4 c35ad2 96d269 0000e1 2d9696 f00fc3 d28787 c31ee1 c3785a
a54b96 b4a53c f069e1 ffb487 5ac378 a569a5 780f87 7869a5 c36996 4bfff0 96000f 5ad2e1 2db4e1 693cd2 e12d00 5aff5a
69874b 003cd2 87a5a5 f0a5d2 6996b4 0f5a96 a5d2f0 5af0f0 8778d2 964b4b c3e187 f078d2 ffe15a 5a00a5 1ea5d2 69c3c3
a5c34b b4a54b 783c5a 4b962d a50f78 8787f0 c33ce1 b42d87 5a0f96 b45a5a c3695a 0f1ed2 2d8778 780f2d a5e1c3 d2a569
783cc3 d296b4 3cb487 5ae187 f0c34b 3cb496 c3e1a5 5a00b4 ffe169 a54b5a a5000f 87d23c 00b4f0 2da51e 008769 870fa5
964bf0 4bffc3 2d5a3c 1e78c3 b4d296 784b1e 2d9669 f0d23c 69a5ff 4be1b4 4b9678 695aa5 b4b4ff 781e3c 875ab4 5a6969
"""
PALETTE = np.frombuffer(bytes.fromhex("".join(_HEX.split())), dtype=np.uint8).reshape(-1, 3)  # [256, 3], read-only

TIERS = (20, 64, 256)  # of PALETTE: the first colours differ most
_WORDS = (  # of indoor scenes, for each of the first 20 colours
    "cushion, pillow | desk, counter, countertop, stool, bench | floor | ceiling | chair, armchair, swivel chair "
    "| sofa, couch | window, windowpane, glass | picture, painting, poster, mirror | door | curtain, blind, "
    "blinds, window blind, shower curtain | cabinet, wardrobe, dresser, chest of drawers | sink, basin, toilet, "
    "bathtub, vase, bottle | television, tv, monitor, screen, computer | plant, flower, tree | table, coffee "
    "table, dining table, night table | rug, carpet, mat | wall | bed, blanket, bedding | shelf, bookshelf, "
    "bookcase, book, books | lamp, light, ceiling light"
)
_ROWS = [row.split(", ") for row in _WORDS.split(" | ")]
_HOMES = {word: slot for slot, row in enumerate(_ROWS) for word in row}
_RANKS = {word: rank for row in _ROWS for rank, word in enumerate(row)}


def palette(
    labels: Tensor | np.ndarray[Any, Any],  # [...] int
    names: Any = None,
) -> np.ndarray[Any, Any]:  # [..., 3] uint8
    """The colour of each label, safe for colour-blind eyes; -1 is grey. From 256 on the colours repeat.

    With all class names by index, or what has them (a label set, a field, a cloud), a class has the same colour in every
    scene (`name_slots`). Without names, and if it is called `class k`, label k has the k-th colour.

    Raises:
        TypeError: if the labels are not integers.
        ValueError: if one is below -1, or has no name.

    Example:
        >>> import torch
        >>> palette(torch.tensor([0, -1])).tolist()
        [[241, 234, 11], [128, 128, 128]]
        >>> chair, same = palette(torch.tensor([0]), ["chair", "wall"]), palette(torch.tensor([1]), ["rug", "chair"])
        >>> bool((chair == same).all())
        True
    """
    values, names = as_array(labels, "labels"), getattr(names, "names", names)
    if not np.issubdtype(values.dtype, np.integer):
        raise TypeError(f"labels: expected integers, got {values.dtype}; convert them first")
    values = values.astype(np.int64)
    if values.size and values.min() < -1:
        raise ValueError(f"labels: expected class indices or -1, got {values.min()}; map other codes to -1 first")
    if names is not None and values.size and values.max() >= len(names):
        raise ValueError(
            f"names: expected a name for every label up to {values.max()}, got {len(names)} names; pass all class names"
        )
    numbered = names is None or all(name == f"class {k}" for k, name in enumerate(names))
    slots = values if numbered else np.array(name_slots(names))[values]
    return np.where((values < 0)[..., None], np.array(UNLABELLED, dtype=np.uint8), PALETTE[slots % len(PALETTE)])


def name_slots(names: Sequence[str]) -> list[int]:
    """The place in `PALETTE` of each class; the order of the names has no influence.

    Words of indoor scenes have a home among the first 20 colours, shared by words of one meaning (sofa, couch). Others get
    one from their CRC-32. If two names share a home, the first word of the row stays there, of other words the first in the
    alphabet; others move to the next free colour: of the first 20, of 64, of 256. `class 7` has colour 7, or one from the end.
    """
    words = [" ".join(name.lower().replace("_", " ").replace("-", " ").split()) for name in names]
    slots: dict[int, int] = {}
    numbers = {i: int(n) % TIERS[-1] for i, word in enumerate(words) if (n := word.removeprefix("class ")).isdecimal()}
    named = sorted(set(range(len(names))) - set(numbers), key=lambda i: (_RANKS.get(words[i], 0), words[i], i))
    for i in named:
        if (home := _HOMES.get(words[i])) is not None and home not in slots.values():
            slots[i] = home
    for i in named:
        slots.setdefault(i, _free_slot(words[i], set(slots.values())))
    moved = {slot: TIERS[-1] - 1 - k for k, slot in enumerate(sorted(slots.values()))}
    slots |= {i: moved.get(number, number) for i, number in numbers.items()}
    return [slots[i] for i in range(len(names))]


def _free_slot(word: str, taken: set[int]) -> int:
    """The first free colour from a word's home on; its home if all are taken."""
    code = crc32(word.encode())
    homes = [(_HOMES.get(word, code % TIERS[0]), 0, TIERS[0])]
    homes += [(low + code % (high - low), low, high) for low, high in pairwise(TIERS)]
    for home, low, high in homes:
        for slot in (*range(home, high), *range(low, home)):
            if slot not in taken:
                return slot
    return homes[0][0]
