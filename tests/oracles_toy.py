"""The toy room's rays by brute force: step along a ray until a point lies inside a solid, then bisect."""

import math

import numpy as np


def inside(solid, point) -> bool:
    """Whether a world point lies in a box or ellipsoid, from the definitions."""
    dx, dy, dz = (point[i] - solid.center[i] for i in range(3))
    x = math.cos(solid.yaw) * dx + math.sin(solid.yaw) * dy  # turn back by -yaw
    y = -math.sin(solid.yaw) * dx + math.cos(solid.yaw) * dy
    a, b, c = solid.half
    if solid.shape == "box":
        return abs(x) <= a and abs(y) <= b and abs(dz) <= c
    return (x / a) ** 2 + (y / b) ** 2 + (dz / c) ** 2 <= 1.0


def first_hit(solids, origin, direction, far: float, step: float):
    """(t, index) of the first solid along `origin + t * direction`; solids thinner than a step may be missed."""
    for k in range(1, int(far / step)):
        point = [origin[i] + k * step * direction[i] for i in range(3)]
        for index, solid in enumerate(solids):
            if inside(solid, point):
                low, high = (k - 1) * step, k * step
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if inside(solid, [origin[i] + middle * direction[i] for i in range(3)]):
                        high = middle
                    else:
                        low = middle
                return high, index
    return np.inf, -1
