"""Protocols written a second time, in the dullest way: loops over pixels, points and classes in NumPy float64.

From ../shared/reference/protocols.md alone; nothing here calls kfgs.
"""

import math

import numpy as np


def relevancy(positive, negatives, scale=10.0):
    worst = 2.0
    for n in negatives:
        a, b = math.exp(scale * positive), math.exp(scale * n)
        worst = min(worst, a / (a + b))
    return worst


def box_mean(image, size=30):
    h, w = image.shape
    before, after = size // 2, size - 1 - size // 2
    padded = np.pad(image, ((before, after), (before, after)), mode="reflect")  # BORDER_REFLECT_101
    out = np.zeros((h, w))
    for y in range(h):
        for x in range(w):
            out[y, x] = padded[y : y + size, x : x + size].mean()
    return out


def pool_mean(image, size=29):
    h, w = image.shape
    reach = size // 2
    out = np.zeros((h, w))
    for y in range(h):
        for x in range(w):
            out[y, x] = image[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1].mean()
    return out


def majority(mask, size=7, skip_last=True):
    h, w = mask.shape
    reach, cut = size // 2, 1 if skip_last else 0
    out = np.zeros((h, w), bool)
    for y in range(h):
        for x in range(w):
            window = mask[
                max(0, y - reach) : min(y + reach + 1, h - cut), max(0, x - reach) : min(x + reach + 1, w - cut)
            ]
            ones = int(window.sum())
            out[y, x] = ones > window.size - ones
    return out


def pool_majority(mask, size=7):
    h, w = mask.shape
    reach = size // 2
    out = np.zeros((h, w), bool)
    for y in range(h):
        for x in range(w):
            out[y, x] = mask[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1].sum() / size**2 > 0.5
    return out


def stretch(values):
    low, high = values.min(), values.max()
    return np.clip(2 * (values - low) / (high - low + 1e-9) - 1, 0, 1)


def iou(a, b):
    union = np.logical_or(a, b).sum()
    return np.logical_and(a, b).sum() / union if union else 0.0


def teacher_agreement(teacher, student, most=7):
    equal, known, counts = 0, 0, {}
    for t, s in zip(teacher.ravel(), student.ravel(), strict=True):
        if t < 0:
            continue
        known += 1
        equal += t == s
        for label in (t, s):
            if label >= 0:
                counts[int(label)] = counts.get(int(label), 0) + 1
    frequent = sorted(counts, key=lambda label: (-counts[label], label))[:most]
    ious = []
    for label in frequent:
        both = either = 0
        for t, s in zip(teacher.ravel(), student.ravel(), strict=True):
            if t >= 0:
                both += t == label and s == label
                either += t == label or s == label
        ious.append(both / either)
    return equal / known, float(np.mean(ious))


def fill_unknown(image):
    known = image[~np.isnan(image)]
    return np.where(np.isnan(image), known.min() if known.size else 0.0, image)


def relevancy_maps(cosines, text, negatives, scale=10.0):
    """From cosines {text: [L, H, W]} to a relevancy [L, H, W]."""
    found = np.zeros(cosines[text].shape)
    for i in np.ndindex(found.shape):
        found[i] = np.nan
        if not np.isnan(cosines[text][i]):
            found[i] = relevancy(cosines[text][i], [cosines[n][i] for n in negatives], scale)
    return np.stack([fill_unknown(level) for level in found])


def lerf_2d(found, mask, boxes, threshold=0.4, filter="langsplat"):
    """IoU of each level, the chosen level, and whether the maximum lies in a box."""
    mean, clean = (box_mean, majority) if filter == "langsplat" else (pool_mean, pool_majority)
    ious, tops, peaks = [], [], []
    for level in found:
        smooth = mean(level)
        blended = 0.5 * (smooth + level)
        ious.append(iou(clean(stretch(blended) > threshold), mask))
        tops.append(blended.max())
        peaks.append(smooth)
    best = peaks[int(np.argmax([peak.max() for peak in peaks]))]
    hit = False
    for y in range(best.shape[0]):
        for x in range(best.shape[1]):
            if best[y, x] == best.max():
                hit = hit or any(x1 <= x <= x2 and y1 <= y <= y2 for x1, y1, x2, y2 in boxes)
    return ious, int(np.argmax(tops)), hit


def nearest(points, query, count):
    """Indices of the nearest points, the closest first."""
    distances = [math.dist(point, query) for point in points]
    return sorted(range(len(points)), key=lambda i: distances[i])[:count]


def select_argmax(cosines, texts, text):
    """From cosines {text: [L, N]}: the Gaussians whose best text it is, in the level with the largest cosine of these."""
    levels, count = cosines[text].shape
    found, tops = [], []
    for level in range(levels):
        mine, top = [], -math.inf
        for n in range(count):
            row = [cosines[t][level, n] for t in texts]
            mine.append(not math.isnan(row[0]) and texts[int(np.argmax(row))] == text)
            top = max(top, cosines[text][level, n]) if mine[-1] else top
        found.append(np.array(mine))
        tops.append(top)
    return found[int(np.argmax(tops))]


def select_by_relevancy(cosines, text, negatives, means, *, threshold, smoothed, neighbours=10):
    levels, count = cosines[text].shape
    known = [n for n in range(count) if not np.isnan(cosines[text][:, n]).any()]
    found, tops = [], []
    for level in range(levels):
        r = np.array([relevancy(cosines[text][level, n], [cosines[m][level, n] for m in negatives]) for n in known])
        if smoothed:
            around = [nearest([means[m] for m in known], means[n], neighbours) for n in known]
            r = np.array([0.5 * (r[i] + np.mean([r[j] for j in near])) for i, near in enumerate(around)])
        tops.append(r.max())
        chosen = stretch(r) > threshold if smoothed else r >= threshold
        found.append(np.isin(np.arange(count), [known[i] for i in np.flatnonzero(chosen)]))
    return found[int(np.argmax(tops))]
