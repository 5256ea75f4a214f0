"""Transposing small matrices of bits, which turns the blocks of each Gaussian into the Gaussians of each block."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

WORDS = 8
"""64-bit words of two matrices of 16 x 16 bits."""

_1, _2, _4, _8, _16, _32 = (np.uint64(1 << k) for k in range(6))
_BITS, _PAIRS = np.uint64(0x0000555500005555), np.uint64(0x0000000033333333)
_NIBBLES, _BYTES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x00FF00FF00FF00FF)
_INLINE: dict[str, Any] = {"nogil": True, "error_model": "numpy", "forceinline": True}


@njit(**_INLINE)
def transpose_bits(words: Any) -> None:
    """Turn the blocks of each of 16 Gaussians into the Gaussians of each of 16 blocks: first for 16 of them, then for 16 more.

    Four words hold a square matrix of 16 x 16 bits, row by row, four rows in each. Its off-diagonal quarters change places,
    then those of each quarter, and so on.
    """
    for half in range(0, WORDS, 4):
        a, b, c, d = words[half], words[half + 1], words[half + 2], words[half + 3]
        t, u = ((a >> _8) ^ c) & _BYTES, ((b >> _8) ^ d) & _BYTES
        a, b, c, d = a ^ (t << _8), b ^ (u << _8), c ^ t, d ^ u
        t, u = ((a >> _4) ^ b) & _NIBBLES, ((c >> _4) ^ d) & _NIBBLES
        a, b, c, d = a ^ (t << _4), b ^ t, c ^ (u << _4), d ^ u
        words[half], words[half + 1] = _transpose_word(a), _transpose_word(b)
        words[half + 2], words[half + 3] = _transpose_word(c), _transpose_word(d)


@njit(**_INLINE)
def _transpose_word(word: Any) -> Any:
    """The last two steps, within four rows."""
    t = ((word >> _2) ^ (word >> _32)) & _PAIRS
    word = word ^ (t << _2) ^ (t << _32)
    t = ((word >> _1) ^ (word >> _16)) & _BITS
    return word ^ (t << _1) ^ (t << _16)
