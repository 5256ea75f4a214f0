"""Slow, literal versions of Sec. 3.4 in numpy float64."""

import numpy as np
from oracles_quant import cosine


def most_similar(features, rows):
    """Index of the row with the largest cosine, the first of equals; -1 for an all-zero feature."""
    result = []
    for feature in np.asarray(features, dtype=np.float64):
        scores = [cosine(feature, row) for row in np.asarray(rows, dtype=np.float64)]
        result.append(-1 if not feature.any() else max(range(len(scores)), key=lambda i: (scores[i], -i)))
    return np.array(result)


def transfer(src, labels, dst, distance):
    """Nearest labelled source strictly closer than `distance`, lowest index among equals."""
    out_labels, out_sources, out_distances = [], [], []
    for point in np.asarray(dst, dtype=np.float64):
        best = (np.inf, -1)
        for i, source in enumerate(np.asarray(src, dtype=np.float64)):
            d = float(np.sqrt(((point - source) ** 2).sum()))
            if labels[i] >= 0 and d < distance and d < best[0]:
                best = (d, i)
        out_distances.append(best[0])
        out_sources.append(best[1])
        out_labels.append(-1 if best[1] < 0 else int(labels[best[1]]))
    return np.array(out_labels), np.array(out_sources), np.array(out_distances)
