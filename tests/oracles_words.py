"""Text embeddings from their definitions, in plain loops and numpy float64."""

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
