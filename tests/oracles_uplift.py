"""Features of maps carried to Gaussians, one pixel and one Gaussian at a time, in numpy float64."""

import numpy as np
from oracles_splat import render


def blend_weights(means, quats, scales, opacities, viewmat, K, width, height):
    """w = T alpha of each Gaussian at each pixel, [H, W, N]: what a rendering shows of the i-th unit vector is w_i."""
    return render(means, quats, scales, opacities, np.eye(len(means)), viewmat, K, width, height)[0]


def means_by_weight(weights, signals):
    """The mean of some signals [H, W, D] for each Gaussian, and its total weight; pixels with NaN say nothing."""
    N, D = weights[0].shape[2], signals[0].shape[2]
    sums, totals = np.zeros((N, D)), np.zeros(N)
    for view, signal in zip(weights, signals, strict=True):
        for y in range(signal.shape[0]):
            for x in range(signal.shape[1]):
                if np.isnan(signal[y, x]).any():
                    continue
                for g in range(N):
                    sums[g] += view[y, x, g] * signal[y, x]
                    totals[g] += view[y, x, g]
    return np.array([s / t if t > 0 else 0 * s for s, t in zip(sums, totals, strict=True)]), totals


def unit_maps(maps):
    """Features of length 1, and NaN for all-zero ones."""
    lengths = [np.sqrt((features**2).sum(-1, keepdims=True)) for features in maps]
    return [f / np.where(length > 1e-8, length, np.nan) for f, length in zip(maps, lengths, strict=True)]


def lacking(weights, signals, features):
    """Maps, as far as Gaussians cover their pixels, less what the Gaussians show with some features."""
    result = []
    for view, signal in zip(weights, signals, strict=True):
        shown = np.zeros(signal.shape)
        for y in range(signal.shape[0]):
            for x in range(signal.shape[1]):
                shown[y, x] = sum(view[y, x, g] * features[g] for g in range(len(features)))
                shown[y, x] += (1 - view[y, x].sum()) * signal[y, x]
        result.append(signal - shown)
    return result


def reliable_share(one, other, places, neighbours):
    """2 r / (1 + r) of each Gaussian, r = sum of products over mean sum of squares, among its nearest ones."""
    result = []
    for place in places:
        near = sorted(range(len(places)), key=lambda i: ((places[i] - place) ** 2).sum())[:neighbours]
        products = sum(float((one[i] * other[i]).sum()) for i in near)
        squares = sum(float((one[i] ** 2).sum() + (other[i] ** 2).sum()) / 2 for i in near)
        r = max(0.0, products / squares) if squares > 0 else 0.0
        result.append(2 * r / (1 + r))
    return np.array(result)


def trust(height, width):
    """How much each pixel counts: four times its distance from the nearest border, in picture sizes; 0.05 to 1."""
    y, x = np.mgrid[:height, :width] + 0.5
    edges = [x / width, 1 - x / width, y / height, 1 - y / height]
    return np.clip(4 * np.min(edges, axis=0), 0.05, 1)[..., None]


def uplift(weights, maps, places, corrections, neighbours):
    """The fused feature of each Gaussian: even and odd views apart, some passes of SIRT, and the mean of both by weight."""
    signals = unit_maps(maps)
    halves = [range(0, len(maps), 2), range(1, len(maps), 2)]
    views = [[weights[i] for i in half] for half in halves]
    counted = [[view * trust(*view.shape[:2]) for view in half] for half in views]
    shown = [[signals[i] for i in half] for half in halves]
    (even, even_weight), (odd, odd_weight) = (means_by_weight(counted[h], shown[h]) for h in (0, 1))
    for _ in range(corrections):
        of_even = means_by_weight(counted[0], lacking(views[0], shown[0], even))[0]
        of_odd = means_by_weight(counted[1], lacking(views[1], shown[1], odd))[0]
        share = reliable_share(of_even, of_odd, places, neighbours)
        even, odd = even + share[:, None] * of_even, odd + share[:, None] * of_odd
    total = even_weight + odd_weight
    both = even * even_weight[:, None] + odd * odd_weight[:, None]
    return np.array([b / t if t > 0 else 0 * b for b, t in zip(both, total, strict=True)]), total
