"""Store rotations as the three smaller components of a unit quaternion; the fourth is positive and follows from them."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .values import unit_quats

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the other components, by the index of the largest


def pack_smallest_three(
    quats: Tensor,  # [N, 4] wxyz, of any length
    steps: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:  # [N, 1] in 0..3, [N, 3] in 0..steps
    """The index of the largest component in (w, x, y, z), and the other three in whole steps.

    Each of the three lies between -1/sqrt(2) and 1/sqrt(2), which are steps 0 and `steps`. A quaternion of length 0 is
    read as the identity. Of equally large components the first is the largest.
    """
    largest, small = split_largest(unit_quats(quats.detach().cpu().double()).numpy())
    whole = np.clip(np.round((small * math.sqrt(0.5) + 0.5) * steps), 0, steps).astype(np.int64)
    return largest[:, None], whole


def unpack_smallest_three(
    largest: NDArray[np.int64],  # [N] in 0..3
    small: NDArray[np.float32],  # [N, 3] in 0..steps
    steps: int,
) -> Tensor:  # [N, 4] wxyz float32, of length 1
    """The inverse of `pack_smallest_three`; if the three components are longer than 1 together, they are shortened."""
    return torch.from_numpy(
        join_largest(largest, (small / np.float32(steps) - np.float32(0.5)) * np.float32(math.sqrt(2)))
    )


def split_largest(
    quats: NDArray[np.float64],  # [N, 4] of length 1, in any order of components
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # [N] in 0..3, [N, 3]
    """The index of the largest component, and the other three in order, with the sign that makes the largest positive."""
    largest = np.abs(quats).argmax(1).astype(np.int64)
    rows = np.arange(len(quats))
    return largest, quats[rows[:, None], _OTHERS[largest]] * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]


def join_largest(
    largest: NDArray[np.int64],  # [N] in 0..3
    small: NDArray[np.float32],  # [N, 3]
) -> NDArray[np.float32]:  # [N, 4]
    """The inverse of `split_largest`; if the three components are longer than 1 together, they are shortened."""
    squares = (small**2).sum(1, keepdims=True)
    quats = np.empty((len(small), 4), np.float32)
    rows = np.arange(len(small))
    quats[rows[:, None], _OTHERS[largest]] = small / np.sqrt(np.maximum(squares, 1))
    quats[rows, largest] = np.sqrt(np.maximum(0, 1 - squares[:, 0]))
    return quats


def rotation_error(steps: int) -> float:
    """The largest angle in radians between a rotation and its stored value.

    Each stored component is off by d = sqrt(2) / steps / 2 at most. The largest, m >= 1/2, is off by (a . e) / m, which is
    at most 3 d (all four components 1/2); the quaternion then by sqrt(12) d, the rotation by twice that.
    """
    return 2 * math.sqrt(12) * math.sqrt(2) / steps / 2 * 1.02 + 1e-5  # second order, and float32
