"""The exponential function in plain arithmetic, so that a compiler can compute it for many pixels at once."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

_LOG2_E = np.float32(1.4426950408889634)
_LN2_HIGH = np.float32(0.693359375)  # few bits: its product with a small integer is exact
_LN2_LOW = np.float32(-2.12194440e-4)
_ROUND = np.float32(12582912.0)  # 1.5 * 2^23: adding it rounds to an integer, kept in the lowest bits
_LOWEST = np.float32(-80.0)  # exp(-80) = 2e-35 is still a normal float32
_MANTISSA_BITS = np.int32(23)
# 1 + r + C2 r^2 + ... on |r| <= ln(2) / 2, fitted to the least largest relative error (3e-9).
_C2, _C3, _C4, _C5, _C6 = (
    np.float32(c) for c in (0.49999993432, 0.16666520399, 0.04166839079, 0.00836874514, 0.00138145401)
)
_ONE = np.float32(1.0)


def exp_negative(x: Any) -> Any:
    """exp(x) for x <= 0, to be called inside compiled code.

    For float32, exp(x) = 2^n exp(r) with n = round(x / ln 2): the polynomial gives exp(r), and adding n to the bits of
    its exponent multiplies by 2^n. The relative error is below 1e-7; x < -80 gives exp(-80). For float64 it is math.exp.
    """
    return math.exp(x)


@overload(exp_negative, jit_options={"fastmath": {"contract", "nsz"}})
def _compiled_exp_negative(x: Any) -> Any:
    def exp_float64(x: Any) -> Any:
        return math.exp(x)

    def exp_float32(x: Any) -> Any:
        x = max(x, _LOWEST)
        shifted = x * _LOG2_E + _ROUND
        n = shifted - _ROUND
        r = (x - n * _LN2_HIGH) - n * _LN2_LOW
        y = _ONE + r * (_ONE + r * (_C2 + r * (_C3 + r * (_C4 + r * (_C5 + r * _C6)))))
        scale = np.int32(np.float32(shifted).view(np.int32) << _MANTISSA_BITS)
        bits = np.int32(np.float32(y).view(np.int32) + scale)
        return np.int32(bits).view(np.float32)

    return exp_float32 if x == types.float32 else exp_float64
