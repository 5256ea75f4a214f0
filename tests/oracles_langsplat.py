"""LangSplat's maps written out pixel by pixel, from the description of the files alone."""

import numpy as np


def dense(index, rows, level, height, width):
    """[height, width, D] float64: each cell takes the mask's feature at the pixel that holds the cell's centre."""
    H, W = index.shape[1:]
    out = np.zeros((height, width, rows.shape[1]))
    for i in range(height):
        for j in range(width):
            y, x = (i + 0.5) * H / height, (j + 0.5) * W / width  # pixel r covers [r, r + 1)
            mask = int(index[level, int(y), int(x)])
            if mask >= 0:
                out[i, j] = rows[mask].astype(np.float64)
    return out
