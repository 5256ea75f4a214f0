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
    found, tops = [], []
    for level in range(levels):
        known = [n for n in range(count) if not np.isnan(cosines[text][level, n])]
        if not known:
            found.append(np.zeros(count, bool))
            tops.append(-math.inf)
            continue
        r = np.array([relevancy(cosines[text][level, n], [cosines[m][level, n] for m in negatives]) for n in known])
        if smoothed:
            around = [nearest([means[m] for m in known], means[n], neighbours) for n in known]
            r = np.array([0.5 * (r[i] + np.mean([r[j] for j in near])) for i, near in enumerate(around)])
        tops.append(r.max())
        chosen = stretch(r) > threshold if smoothed else r >= threshold
        found.append(np.isin(np.arange(count), [known[i] for i in np.flatnonzero(chosen)]))
    return found[int(np.argmax(tops))]


def legaussians(found, mask, threshold=0.5):
    """IoU, accuracy, precision, and the sum of 101 interpolated precisions, of one relevancy map."""
    seen = found >= threshold
    tp, fp = int((seen & mask).sum()), int((seen & ~mask).sum())
    points = []
    for i in range(101):
        above = found > i / 100
        both = int((above & mask).sum())
        points.append((both / above.sum() if above.any() else 0.0, both / mask.sum() if mask.any() else 0.0))
    area = 0.0
    for i in range(101):
        area += max((p for p, r in points if r >= i / 100), default=0.0)
    return tp / ((seen | mask).sum() + 1e-6), float((seen == mask).mean()), tp / (tp + fp + 1e-6), area


def scannet(pred, gt, weights=None):
    """mIoU, mAcc and accuracy; gt 0 is not scored, classes count from 1."""
    weights = np.ones(len(gt)) if weights is None else weights
    pred = np.where(gt == 0, 0, pred)
    ious, recalls, right, total = [], [], 0.0, 0.0
    for c in sorted(set(gt.tolist()) - {0}):
        both = either = true = 0.0
        for p, g, w in zip(pred, gt, weights, strict=True):
            both += w * (p == c and g == c)
            either += w * (p == c or g == c)
            true += w * (g == c)
        ious.append(both / either)
        recalls.append(both / true)
        right, total = right + both, total + true
    return float(np.mean(ious)), float(np.mean(recalls)), right / total


def rotation(q):
    w, x, y, z = np.asarray(q) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def gaussian_truth(means, quats, scales, points, labels, nearest_count=1000, radius=5.0, balanced=True, far=False):
    """Labels count from 1, 0 = none."""
    out = []
    known = [i for i in range(len(points)) if labels[i] > 0]
    for mean, q, s in zip(means, quats, scales, strict=True):
        order = sorted(known, key=lambda i: math.dist(points[i], mean))[:nearest_count]
        near = [i for i in order if math.dist(points[i], mean) <= radius * max(s)]
        inverse = np.linalg.inv(rotation(q) @ np.diag(np.square(s)) @ rotation(q).T)
        sums, counts = {}, {}
        for i in near:
            d = points[i] - mean
            squared = d @ inverse @ d
            sums[labels[i]] = sums.get(labels[i], 0.0) + (math.sqrt(squared) if far else math.exp(-0.5 * squared))
            counts[labels[i]] = counts.get(labels[i], 0) + 1
        best = [(-sums[c] / (counts[c] if balanced else 1), c) for c in sums]
        out.append(min(best)[1] if best else 0)
    return np.array(out)


def median5(values):
    """Median of five; beyond the ends values are mirrored with the edge repeated."""
    n = len(values)
    out = []
    for i in range(n):
        window = []
        for j in range(i - 2, i + 3):
            j = -j - 1 if j < 0 else j
            window.append(values[2 * n - 1 - j if j >= n else j])
        out.append(sorted(window)[2])
    return out


def stable_threshold(level, steepest=0.4, fractions=(0.005, 0.9), run=5):
    """(slope, threshold) of a level's last stable run, or None."""
    score = (level - level.min()) / max(level.max() - level.min(), 1e-9)
    ts = [i / 100 for i in range(1, 100)]
    means = [float(score[score > t].mean()) if (score > t).any() else 0.0 for t in ts]
    shares = [float((score > t).mean()) for t in ts]

    def steps(values):
        out = []
        for i in range(99):
            a, b = max(i - 1, 0), min(i + 1, 98)
            out.append(abs((values[b] - values[a]) / (ts[b] - ts[a])))
        return median5(out)

    mean_steps, share_steps = steps(means), steps(shares)
    runs, current = [], []
    for i in range(99):
        inside = fractions[0] < shares[i] < fractions[1]
        if mean_steps[i] < steepest and share_steps[i] < steepest and inside:
            current.append(i)
        else:
            runs, current = [*runs, current], []
    runs = [one for one in [*runs, current] if len(one) >= run]
    if not runs:
        return None
    last = runs[-1]
    return float(np.mean([mean_steps[i] for i in last])), ts[last[(len(last) - 1) // 2]]


def stable_mask(found, **options):
    best, level = None, 0
    for i, one in enumerate(found):
        run = stable_threshold(one, **options)
        if run is not None and (best is None or run[0] < best[0]):
            best, level = run, i
    if best is None:
        level = int(np.argmax([one.max() for one in found]))
    threshold = 0.5 if best is None else best[1]
    score = (found[level] - found[level].min()) / max(found[level].max() - found[level].min(), 1e-9)
    return score > threshold, level, threshold


def vote_nearest(points, means, labels, count=25):
    out = []
    for point in points:
        votes = {}
        for i in nearest(means, point, count):
            votes[labels[i]] = votes.get(labels[i], 0) + 1
        out.append(min(votes, key=lambda c: (-votes[c], c == -1, c)))
    return np.array(out)


def scenesplat(pred, gt, classes, dropped):
    """f-mIoU, f-mAcc, mIoU, mAcc and accuracy; gt -1 is not scored."""
    ious, recalls = {}, {}
    for c, name in enumerate(classes):
        both = sum(p == c and g == c for p, g in zip(pred, gt, strict=True))
        either = sum((p == c or g == c) and g >= 0 for p, g in zip(pred, gt, strict=True))
        true = sum(g == c for g in gt)
        if true:
            ious[name], recalls[name] = both / either, both / true
    front = [name for name in ious if name not in dropped]
    scored = [(p, g) for p, g in zip(pred, gt, strict=True) if g >= 0]
    return (
        np.mean([ious[n] for n in front]),
        np.mean([recalls[n] for n in front]),
        np.mean(list(ious.values())),
        np.mean(list(recalls.values())),
        np.mean([p == g for p, g in scored]),
    )
