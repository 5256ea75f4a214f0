"""How the palette's table is measured: colours that differ for three kinds of eyes."""

import numpy as np
from skimage.color import rgb2lab

# Found by a random search: one colour at a time was replaced by the best of 120 others, for the smallest CIEDE2000 distance
_FIRST = """
f1ea0b 8000d7 6c3200 9be5ff ed6a31 0088ff eee1e4 ff22c1 573852 c2a2ff
766800 62a271 084682 1c5b33 f5a40a ad4f58 dceac8 f0989f 027280 00ff8f
"""
FIRST = _FIRST.split()
# Machado, Oliveira and Fernandes 2009, severity 1.0, on linear RGB
EYES = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
}


def linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def display(rgb):
    rgb = np.clip(rgb, 0, 1)
    return np.where(rgb <= 0.0031308, rgb * 12.92, 1.055 * rgb ** (1 / 2.4) - 0.055)


def seen(rgb8):
    """CIELAB of 8-bit colours as each kind of eye sees them, [3, N, 3]."""
    light = linear(np.asarray(rgb8, dtype=np.float64) / 255)
    return np.stack([rgb2lab(display(light @ np.asarray(matrix).T)) for matrix in EYES.values()])


def worst_distance(a, b):
    """Smallest of the three eyes' CIE76 distances between colours a [N, 3] and b [M, 3] -> [N, M]."""
    return np.linalg.norm(seen(a)[:, :, None] - seen(b)[:, None, :], axis=-1).min(axis=0)
