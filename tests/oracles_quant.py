"""Slow, literal versions of Eq. 5-10 in numpy float64, one feature at a time."""

import numpy as np


def cosine(a, b):
    length = np.sqrt((a * a).sum()) * np.sqrt((b * b).sum())
    return 0.0 if length == 0 else float((a * b).sum() / length)


def quantize(features, codewords):
    """Eq. 5: the codeword of largest cosine, the first of equal ones."""
    result = []
    for f in features:
        best = 0
        for e in range(1, len(codewords)):
            if cosine(f, codewords[e]) > cosine(f, codewords[best]):
                best = e
        result.append(best)
    return np.array(result)


def balanced_loss(features, codewords, index):
    """Eq. 6-7: (1/T) sum over classes of (1/N_tau) sum over pixels of (1 - cos) delta(M, tau)."""
    classes = sorted(set(int(t) for t in index))
    total = 0.0
    for tau in classes:
        N = sum(1 for t in index if t == tau)
        inner = 0.0
        for i in range(len(features)):
            delta = 1.0 if index[i] == tau else 0.0
            inner += (1.0 - cosine(features[i], codewords[index[i]])) * delta
        total += inner / N
    return total / len(classes)


def farthest_points(features, count):
    """The least similar pair, then always the point whose nearest picked one is farthest."""
    n = len(features)
    pairs = [(cosine(features[i], features[j]), i, j) for i in range(n) for j in range(i + 1, n)]
    _, i, j = min(pairs)
    picked = [i, j]
    while len(picked) < min(count, n):
        rest = [k for k in range(n) if k not in picked]
        picked.append(min(rest, key=lambda k: (max(cosine(features[k], features[p]) for p in picked), k)))
    return picked[:count]


def expand(codewords, features, threshold, maximum):
    """Eq. 8, the least similar feature first, similarities updated after each."""
    book, chosen = list(codewords), []
    while len(book) < maximum:
        scores = [(max(cosine(f, c) for c in book), i) for i, f in enumerate(features) if i not in chosen and f.any()]
        if not scores or min(scores)[0] >= threshold:
            break
        i = min(scores)[1]
        chosen.append(i)
        book.append(features[i])
    return chosen


def prune(codewords, threshold):
    """Eq. 9 with e < g, visiting g in order and comparing with what is still there."""
    stays = []
    for g in range(len(codewords)):
        if not any(cosine(codewords[e], codewords[g]) > threshold for e in stays):
            stays.append(g)
    return stays


def mlp(layers, rows):
    """Linear layers with ReLU between, one row at a time."""
    out = []
    for row in np.asarray(rows, dtype=np.float64):
        for i, (weight, bias) in enumerate(layers):
            if i:
                row = np.maximum(row, 0)
            row = np.asarray(weight, dtype=np.float64) @ row + np.asarray(bias, dtype=np.float64)
        out.append(row)
    return np.array(out)


def unit(rows):
    return np.array([row / np.sqrt((row * row).sum()) for row in rows])
