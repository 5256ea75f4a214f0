"""Compressed PLY and smallest-three rotations decoded one Gaussian at a time, from the formats' equations, in float64."""

import math

import numpy as np

C0 = 0.5 / math.sqrt(math.pi)


def smallest_three(largest: int, small: list[float], steps: int) -> list[float]:  # -> w, x, y, z
    """Three components from -1/sqrt(2) to 1/sqrt(2) in whole steps; the fourth makes the length 1."""
    values = [(s / steps * 2 - 1) / math.sqrt(2) for s in small]
    values.insert(largest, math.sqrt(max(0.0, 1 - sum(v * v for v in values))))
    return values


def compressed_gaussian(elements: dict[str, dict[str, np.ndarray]], i: int) -> dict[str, np.ndarray]:
    """Gaussian `i` of the three elements of a compressed PLY."""
    chunk = {name: float(column[i // 256]) for name, column in elements["chunk"].items()}
    words = {name: int(column[i]) for name, column in elements["vertex"].items()}

    def between(kind: str, axis: str, fraction: float) -> float:
        low, high = chunk.get(f"min_{kind}{axis}", 0.0), chunk.get(f"max_{kind}{axis}", 1.0)
        return low + (high - low) * fraction

    def vector(word: int) -> list[float]:
        return [(word >> 21) / 2047, (word >> 11) % 1024 / 1023, word % 2048 / 2047]

    position = [between("", a, f) for a, f in zip("xyz", vector(words["packed_position"]), strict=True)]
    scale = [math.exp(between("scale_", a, f)) for a, f in zip("xyz", vector(words["packed_scale"]), strict=True)]
    word = words["packed_rotation"]
    quat = smallest_three(word >> 30, [(word >> 20) % 1024, (word >> 10) % 1024, word % 1024], 1023)
    word = words["packed_color"]
    rgb = [between("", a, (word >> shift) % 256 / 255) for a, shift in zip("rgb", (24, 16, 8), strict=True)]
    sh = [[(value - 0.5) / C0 for value in rgb]]
    rest = elements.get("sh", {})
    for k in range(len(rest) // 3):
        row = []
        for channel in range(3):
            byte = int(rest[f"f_rest_{channel * (len(rest) // 3) + k}"][i])
            row.append({0: -4.0, 255: 4.0}.get(byte, ((byte + 0.5) / 256 - 0.5) * 8))
        sh.append(row)
    return {
        "means": np.array(position),
        "scales": np.array(scale),
        "quats": np.array(quat),
        "opacities": np.array(words["packed_color"] % 256 / 255),
        "sh": np.array(sh),
    }
