"""Tensors as arrays, for what draws."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor


def as_array(values: Tensor) -> np.ndarray[Any, Any]:
    """A tensor's values as NumPy has them, from any device and without its gradient."""
    array: np.ndarray[Any, Any] = values.detach().cpu().numpy()
    return array
