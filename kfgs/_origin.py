"""Coordinates far from zero (UTM, ECEF, site grids): in memory they are float32, counted from an origin in float64.

Readers parse in float64, call `choose_origin`, and keep the `recounted` places in float32. Answers and files for people pass
through `to_world`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ._check import ORIGIN

Origin = tuple[float, float, float]
FAR = 1000  # sizes of a scene between it and zero: beyond, float32 has fewer than 8,000 of its steps across the scene
FAR_UNITS = 10_000  # world units: beyond, a step of float32 is a millimetre, if the unit is a metre
ONE_PLACE = 1e-6  # of the distance to zero: what spreads less stands in one place up to rounding, and has no scale


def choose_origin(*places: Tensor) -> Origin:  # each [N, 3]
    """(0, 0, 0), or a round place in the middle if float32 would lose something there. Values that are not finite are ignored.

    Example:
        >>> room = torch.linspace(-2, 2, 300, dtype=torch.float64).reshape(100, 3)
        >>> choose_origin(room), choose_origin(room + torch.tensor([448262.0, 5411932.0, 200.0]))
        ((0.0, 0.0, 0.0), (448262.0, 5411932.0, 200.0))
    """
    points = torch.cat([place.detach().double().cpu() for place in places]) if places else torch.zeros(0, 3)
    points = points[points.isfinite().all(1)]
    if len(points) == 0:
        return ORIGIN
    middle = points.median(0).values
    size, distance = float((points - middle).abs().amax(1).median()), float(middle.abs().max())
    scaled = size > ONE_PLACE * distance and distance > FAR * size
    if not (scaled or (distance > FAR_UNITS and distance > 10 * size)):
        return ORIGIN
    step = 10.0 ** math.ceil(math.log10(size)) if size > ONE_PLACE * distance else 1.0
    x, y, z = (middle / step).round().mul(step).tolist()
    return x, y, z


def recounted(points: Tensor, origin: Origin, other: Origin) -> Tensor:  # [..., 3]
    """Places counted from another origin: in float64, or as they are if it is the same."""
    shift = [a - b for a, b in zip(origin, other, strict=True)]
    return points.double() + points.new_tensor(shift, dtype=torch.float64) if any(shift) else points


def to_world(points: Tensor, origin: Origin) -> Tensor:  # [..., 3]
    """Places in the world: in float64, or as they are if they are counted from zero."""
    return recounted(points, origin, ORIGIN)


def describe_origin(origin: Origin, what: str) -> list[str]:
    """A note for people; none if coordinates are counted from zero."""
    place = ", ".join(f"{value:.15g}" for value in origin)
    note = f"coordinates of {what} are relative to the origin ({place}): float32 has 7 digits; answers are in the world"
    return [] if origin == ORIGIN else [note]
