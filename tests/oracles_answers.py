"""What trained Gaussians show in some views, one pixel at a time, in numpy float64."""

import numpy as np
from oracles_quant import quantize
from oracles_uplift import means_by_weight


def codeword_map(rendered, codewords, centres=None):
    """The unit codeword of each rendered pixel: of largest cosine, or the one whose centre is nearest in latent space."""
    result = np.zeros((*rendered.shape[:2], codewords.shape[1]))
    for y in range(rendered.shape[0]):
        for x in range(rendered.shape[1]):
            if centres is None:
                k = quantize(rendered[y, x][None], codewords)[0]
            else:
                k = min(range(len(centres)), key=lambda i: ((rendered[y, x] - centres[i]) ** 2).sum())
            result[y, x] = codewords[k] / np.sqrt((codewords[k] ** 2).sum())
    return result


def unit_map(rendered):
    """Each rendered feature with length 1; an all-zero one stays."""
    lengths = np.sqrt((rendered**2).sum(axis=2, keepdims=True))
    return np.divide(rendered, lengths, out=np.zeros_like(rendered), where=lengths > 1e-8)


def fused(weights, features, shown):
    """The mean for each Gaussian of `shown(rendered)` over the views, and its pixels."""
    return means_by_weight(weights, [shown(view @ features) for view in weights])
