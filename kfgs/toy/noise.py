"""Repeatable randomness over space: smooth noise at a point, and a fixed random number for an integer cell."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[np.float64]
LATTICE = 48  # random values along each edge of the noise volume, mirrored beyond it


class Noise:
    """Band-limited value noise in [-1, 1] over R^3: a random lattice, interpolated trilinearly by `grid_sample`."""

    def __init__(self, rng: np.random.Generator) -> None:
        values = rng.uniform(-1.0, 1.0, (1, 1, LATTICE, LATTICE, LATTICE))
        self.volume = torch.from_numpy(values.astype(np.float32))

    def layer(self, points: Array, wavelength: float) -> Array:  # [N, 3] -> [N]
        """One octave: lattice points `wavelength` / 2 metres apart."""
        grid = torch.from_numpy((points * (4.0 / (wavelength * (LATTICE - 1)))).astype(np.float32))
        out = torch.nn.functional.grid_sample(
            self.volume, grid[None, None, None], mode="bilinear", padding_mode="reflection", align_corners=True
        )
        return out.flatten().double().numpy()

    def fractal(
        self, points: Array, wavelength: float, footprint: Array, octaves: int = 6, gain: float = 0.7
    ) -> Array:  # [N, 3], [N] -> [N]
        """Octaves from `wavelength` down; those near the size of a pixel (`footprint`, metres) are faded."""
        total = np.zeros(len(points))
        weight = 1.0
        for octave in range(octaves):
            fade = np.clip((wavelength / footprint - 1.0) / 2.0, 0.0, 1.0)
            if weight * fade.max(initial=0.0) > 0:
                total += weight * fade * self.layer(points + 0.37 * octave, wavelength)
            weight, wavelength = weight * gain, wavelength / 2.13  # not 2: the mirrored periods must not line up
        return total


def hashed(cells: NDArray[np.int64], seed: int) -> Array:  # [N, n] -> [N] in [0, 1)
    """A fixed random number for each integer cell."""
    mixed = np.full(len(cells), seed * 7919 + 17, np.uint64)
    for column in cells.astype(np.uint64).T:
        mixed = (mixed ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53
