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
    """Eq. 8: features whose cosine with their codeword is below alpha, the least similar if there is less room."""
    index = quantize(features, codewords)
    scores = [(cosine(features[i], codewords[index[i]]), i) for i in range(len(features))]
    return [i for score, i in sorted(scores) if score < threshold][: maximum - len(codewords)]


def expand_apart(codewords, features, threshold, maximum, most):
    """The least similar feature, similarities updated after each."""
    book, chosen = list(codewords), []
    while len(book) < maximum and len(chosen) < most:
        score, i = min((max(cosine(f, c) for c in book), i) for i, f in enumerate(features))
        if score >= threshold:
            break
        chosen.append(i)
        book.append(features[i])
    return chosen


def prune(codewords, threshold):
    """Eq. 9: f_g goes for every pair e < g of the codebook that is too similar."""
    pairs = [(e, g) for g in range(len(codewords)) for e in range(g)]
    gone = {g for e, g in pairs if cosine(codewords[e], codewords[g]) > threshold}
    return [g for g in range(len(codewords)) if g not in gone]


def evolve(maps, orders, config):
    """Sec. 3.3.1 from the first image to the last step; `orders`: the images of each epoch. Adam as Kingma & Ba print it."""
    book = [[maps[0][i].copy(), 0, 0, 0, 0] for i in farthest_points(maps[0], config.initial)]  # f, m, v, t, gradient
    gathered, history = 0, []
    for epoch, order in enumerate(orders):
        added, losses, before, size = 0, [], [], len(book)
        for seen, image in enumerate(order, start=1):
            F, S = maps[image], [row[0] for row in book]
            limits, most = (config.expand_below, config.maximum), config.joins_per_image
            joins = expand(S, F, *limits) if most is None else expand_apart(S, F, *limits, most)
            before += [cosine(f, S[t]) for f, t in zip(F, quantize(F, S), strict=True)]
            added, book = added + len(joins), book + [[F[i].copy(), 0, 0, 0, 0] for i in joins]
            M = quantize(F, [row[0] for row in book])
            losses.append(balanced_loss(F, [row[0] for row in book], M))
            for f, t in zip(F, M, strict=True):
                s, N, T = book[t][0], list(M).count(t), len(set(M))
                length = np.sqrt((s * s).sum())
                slope = (f / np.sqrt((f * f).sum()) - cosine(f, s) * s / length) / length
                book[t][4] = book[t][4] - slope / (N * T)
            gathered += 1
            if seen == len(order) or epoch < config.eager_epochs or seen % config.step_every == 0:
                for row in book:
                    g = row[4] / gathered
                    row[1], row[2], row[3] = 0.9 * row[1] + 0.1 * g, 0.999 * row[2] + 0.001 * g * g, row[3] + 1
                    m, v = row[1] / (1 - 0.9 ** row[3]), row[2] / (1 - 0.999 ** row[3])
                    row[0], row[4] = row[0] - config.learning_rate * m / (np.sqrt(v) + 1e-9), 0
                gathered = 0
            book = [book[i] for i in prune([row[0] for row in book], config.prune_above)]
        record = {"size": len(book), "added": added, "pruned": size + added - len(book), "loss": np.mean(losses)}
        record |= {"mean_similarity": np.mean(before), "coverage": np.mean(np.array(before) >= config.expand_below)}
        history.append(record)
    return np.array([row[0] for row in book]), history


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
