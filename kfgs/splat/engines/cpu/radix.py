"""Sort floating point numbers by their bits, compiled by numba."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from .cache import cached_njit

_DIGIT = 11
"""Bits sorted at once: 2048 counters stay in the first-level cache, and 32 bits take three passes."""
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


@cached_njit(**_OPTIONS)
def sort_rows(bits: Any) -> Any:
    """Stable radix sort of floating point numbers, given as their bits [M]; returns the rows [M] int32."""
    count, passes = len(bits), (8 * bits.itemsize + _DIGIT - 1) // _DIGIT
    keys, keys_out = np.empty(count, bits.dtype), np.empty(count, bits.dtype)
    rows, rows_out = np.empty(count, np.int32), np.empty(count, np.int32)
    places = np.zeros((passes, 1 << _DIGIT), np.int32)
    for i in range(count):
        key = _sortable(bits[i], bits)
        keys[i], rows[i] = key, i
        for p in range(passes):
            places[p, _digit(key, p, bits)] += 1
    for p in range(passes):
        begin = 0
        for d in range(1 << _DIGIT):
            begin, places[p, d] = begin + places[p, d], begin
        for i in range(count):
            d = _digit(keys[i], p, bits)
            at = places[p, d]
            places[p, d] = at + 1
            keys_out[at], rows_out[at] = keys[i], rows[i]
        keys, keys_out, rows, rows_out = keys_out, keys, rows_out, rows
    return rows


@njit(**_OPTIONS)
def _sortable(value: Any, bits: Any) -> Any:
    """Bits that are in the numbers' order: negative numbers turned round, zero without a sign, NaN above all."""
    kind = bits.dtype.type
    sign = kind(kind(1) << kind(8 * bits.itemsize - 1))
    infinity = kind(kind(0xFF) << kind(23)) if bits.itemsize == 4 else kind(kind(0x7FF) << kind(52))
    size = kind(value & kind(~sign))
    if size > infinity:
        return kind(~kind(0))
    return kind(~value) if value > sign else kind(size | sign)


@njit(**_OPTIONS)
def _digit(key: Any, number: int, bits: Any) -> Any:
    """One digit of a key, the lowest first."""
    kind = bits.dtype.type
    return np.int64(kind(key >> kind(_DIGIT * number)) & kind((1 << _DIGIT) - 1))
