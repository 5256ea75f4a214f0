"""Slow references for selections, written from the definitions in numpy float64."""

import numpy as np


def components(points, distance):
    """Flood fill over all pairs at most `distance` apart; the sets of indices, largest first, then by lowest index."""
    points = np.asarray(points, dtype=np.float64)
    left, found = set(range(len(points))), []
    while left:
        seed = min(left)
        left.remove(seed)
        part, front = {seed}, [seed]
        while front:
            i = front.pop()
            for j in sorted(left):
                if np.sqrt(sum((points[i, c] - points[j, c]) ** 2 for c in range(3))) <= distance:
                    left.remove(j)
                    part.add(j)
                    front.append(j)
        found.append(sorted(part))
    return sorted(found, key=lambda part: (-len(part), part[0]))


def rotation(axis, degrees):
    """Rodrigues' formula: R = I + sin K + (1 - cos) K^2, with K the cross product by the unit axis."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
