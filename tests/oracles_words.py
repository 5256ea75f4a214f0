"""Text embeddings and scores from their definitions, in plain loops and numpy float64."""

import numpy as np


def ensemble(encode, words, templates):
    """Every word in every template, each brought to length 1, summed, brought to length 1. encode: text -> [D]."""
    total = 0.0
    for word in words:
        for template in templates:
            before, after = template.split("{}")
            row = np.asarray(encode(before + word + after), np.float64)
            total = total + row / np.sqrt((row**2).sum())
    return total / np.sqrt((total**2).sum())


def softmax_share(similarity, negatives, scale):
    """exp(l s) / (exp(l s) + sum_j exp(l n_j)) for each row."""
    found = []
    for s, row in zip(np.asarray(similarity, np.float64), np.asarray(negatives, np.float64), strict=True):
        found.append(np.exp(scale * s) / (np.exp(scale * s) + sum(np.exp(scale * n) for n in row)))
    return np.array(found)
