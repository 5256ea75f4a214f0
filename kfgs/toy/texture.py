"""Procedural surface colour: patterns over multi-octave noise, rich enough for SIFT on every surface.

A colour depends only on the place on the object, so all views agree on it. Detail finer than a pixel fades out instead
of aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[np.float64]
Color = tuple[float, float, float]
LATTICE = 48  # random values along each edge of the noise volume, mirrored beyond it


@dataclass(frozen=True)
class Texture:
    """The pattern of one object: its kind, two or more colours (RGB in [0, 1]), its size in metres, its seed."""

    kind: Literal["plaster", "blobs", "wood", "planks", "checks", "stripes", "painting"]
    colors: tuple[Color, ...]
    scale: float = 0.2
    seed: int = 0
    contrast: float = 0.5  # of the noise on top, relative to the colour


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


def _ramp(colors: tuple[Color, ...], value: Array) -> Array:  # [N] in [0, 1] -> [N, 3]
    """Piecewise linear colours over [0, 1]."""
    stops = np.linspace(0.0, 1.0, len(colors))
    return np.stack([np.interp(value, stops, [c[i] for c in colors]) for i in range(3)], axis=-1)


def _hash(cells: NDArray[np.int64], seed: int) -> Array:  # [N, n] -> [N] in [0, 1)
    """A fixed random number for each integer cell."""
    mixed = np.full(len(cells), seed * 7919 + 17, np.uint64)
    for column in cells.astype(np.uint64).T:
        mixed = (mixed ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53


def _pattern(texture: Texture, local: Array, plane: Array, grain: Array, coarse: Array) -> Array:  # -> [N] in [0, 1]
    """Where between the texture's colours each point lies; `plane` [N, 2] are coordinates on the face."""
    s = texture.scale
    if texture.kind == "blobs":
        return 1.0 / (1.0 + np.exp(-9.0 * coarse))
    if texture.kind == "wood":
        return 0.5 + 0.5 * np.sin(2 * np.pi * (plane[:, 1] / s + 0.35 * coarse + 0.1 * grain))
    if texture.kind == "planks":
        row = np.floor(plane[:, 1] / s).astype(np.int64)
        along = plane[:, 0] / (9.0 * s) + _hash(row[:, None], texture.seed)
        tone = _hash(np.stack([row, np.floor(along).astype(np.int64)], -1), texture.seed)
        seam = (np.abs(plane[:, 1] / s - np.round(plane[:, 1] / s)) < 0.05) | (np.abs(along - np.round(along)) < 0.006)
        return np.where(seam, 0.0, 0.25 + 0.75 * tone)
    if texture.kind == "checks":
        cells = np.floor(plane / s).astype(np.int64)
        return 0.15 + 0.7 * ((cells.sum(-1) % 2) * 0.6 + 0.4 * _hash(cells, texture.seed))
    if texture.kind == "stripes":
        row = np.floor(plane[:, 0] / s + 0.15 * coarse).astype(np.int64)
        return _hash(row[:, None], texture.seed)
    if texture.kind == "painting":
        return np.floor(np.clip(0.5 + 0.6 * coarse, 0, 0.999) * 2 * len(texture.colors)) / (2 * len(texture.colors) - 1)
    return np.full(len(local), 0.5)  # plaster: the noise alone


def evaluate(
    texture: Texture,
    noise: Noise,
    local: Array,  # [N, 3] metres, in the object's axes
    axis: NDArray[np.int64],  # [N] the face's normal axis
    footprint: Array,  # [N] metres a pixel covers there
) -> Array:  # [N, 3] RGB, not clipped
    """The unlit colour of an object's points."""
    order = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    plane = np.take_along_axis(local, order, axis=1)
    shifted = local + np.random.default_rng([texture.seed, 5]).uniform(-9.0, 9.0, 3)
    along = np.array([0.3, 1.0, 1.0]) if texture.kind in ("wood", "planks") else 1.0  # streaks along the fibres
    grain = noise.fractal(shifted * along, 0.25, footprint)
    coarse = noise.fractal(shifted + 3.1, 2.0 * texture.scale, footprint, octaves=2)
    color = _ramp(texture.colors, np.clip(_pattern(texture, local, plane, grain, coarse), 0.0, 1.0))
    tint = noise.fractal(shifted + 5.7, 0.17, footprint, octaves=3)[:, None] * np.array([0.5, 0.0, -0.5])
    return color * (1.0 + texture.contrast * (0.6 * grain[:, None] + 0.3 * tint))
