"""Merging Gaussians, one group and one member at a time, in numpy float64."""

import numpy as np
from oracles_splat import covariance


def area(scales):
    """Product of the two larger standard deviations."""
    _, middle, large = sorted(float(s) for s in scales)
    return middle * large


def merged(means, quats, scales, opacities, features, weights, members):
    """Mean, covariance, opacity and feature of a mixture: moments by weight, opacity by covered area."""
    total = sum(float(weights[i]) for i in members)
    mean, feature = np.zeros(3), np.zeros(len(features[0]))
    for i in members:
        mean += weights[i] / total * np.asarray(means[i], float)
        feature += weights[i] / total * np.asarray(features[i], float)
    spread, covered = np.zeros((3, 3)), 0.0
    for i in members:
        away = np.asarray(means[i], float) - mean
        spread += weights[i] / total * (covariance(quats[i], scales[i]) + np.outer(away, away))
        covered += opacities[i] * area(scales[i])
    deviations = np.sqrt(np.linalg.eigvalsh(spread))
    return mean, spread, min(0.99, max(0.05, covered / area(deviations))), feature
