"""SSIM and averaging of blocks, written dully from their definitions."""

import numpy as np


def ssim_windows(a, b, peak=1.0):
    """SSIM of every 11x11 window (Gaussian, sigma 1.5) that lies inside two pictures [H, W, D] (Wang et al. 2004)."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    offsets = np.arange(11) - 5
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights = (weights / weights.sum())[:, :, None]
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    rows, columns = a.shape[0] - 10, a.shape[1] - 10
    found = np.zeros((rows, columns, a.shape[2]))
    for i in range(rows):
        for j in range(columns):
            x, y = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
            mx, my = (weights * x).sum((0, 1)), (weights * y).sum((0, 1))
            vx, vy = (weights * (x - mx) ** 2).sum((0, 1)), (weights * (y - my) ** 2).sum((0, 1))
            cov = (weights * (x - mx) * (y - my)).sum((0, 1))
            found[i, j] = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return found


def block_means(map, divisor):
    """Means of whole blocks of divisor x divisor pixels."""
    rows, columns = map.shape[0] // divisor, map.shape[1] // divisor
    found = np.zeros((rows, columns, map.shape[2]))
    for i in range(rows):
        for j in range(columns):
            block = map[i * divisor : (i + 1) * divisor, j * divisor : (j + 1) * divisor]
            found[i, j] = block.reshape(-1, map.shape[2]).mean(axis=0)
    return found
