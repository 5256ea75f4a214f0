"""Multi-scale sliding-window evaluation, step by step at full resolution in numpy float64."""

import math

import numpy as np


def resize(x, height, width):
    """[C, h, w] -> [C, height, width]: bilinear, corner samples on corner samples, one pixel after another."""
    C, h, w = x.shape
    result = np.zeros((C, height, width))
    for i in range(height):
        y = i * (h - 1) / (height - 1) if height > 1 else 0.0
        y0 = min(int(y), h - 1)
        y1 = min(y0 + 1, h - 1)
        line = (1 - (y - y0)) * x[:, y0] + (y - y0) * x[:, y1]
        for j in range(width):
            z = j * (w - 1) / (width - 1) if width > 1 else 0.0
            z0 = min(int(z), w - 1)
            z1 = min(z0 + 1, w - 1)
            result[:, i, j] = (1 - (z - z0)) * line[:, z0] + (z - z0) * line[:, z1]
    return result


def pad(x, height, width):
    """Black (-1) on the right and below, up to a size."""
    C, h, w = x.shape
    result = np.full((C, max(h, height), max(w, width)), -1.0)
    result[:, :h, :w] = x
    return result


def one_window(x, head, flip):
    """The network with its last enlargement, averaged with the mirrored one: [3, S, S] -> [D, S, S]."""
    S = x.shape[-1]
    output = resize(head(x), S, S)
    if flip:
        mirrored = resize(head(x[:, :, ::-1].copy()), S, S)
        output = (output + mirrored[:, :, ::-1]) / 2
    return output


def evaluate(picture, head, crop, scales, flip):
    """[3, h, w] in [-1, 1] -> [D, h, w]; `head`: [3, crop, crop] -> [D, crop/2, crop/2], numpy float64."""
    base, stride = crop * 520 / 480, int(crop * 2 / 3)
    _, h, w = picture.shape
    total = 0
    for scale in scales:
        long = math.ceil(base * scale)
        if h > w:
            height, width = long, int(w * long / h + 0.5)
        else:
            width, height = long, int(h * long / w + 0.5)
        padded = pad(resize(picture, height, width), crop, crop)
        ph, pw = padded.shape[1:]
        total_here, count = 0, np.zeros((ph, pw))
        for i in range(math.ceil((ph - crop) / stride) + 1):
            for j in range(math.ceil((pw - crop) / stride) + 1):
                y0, x0 = i * stride, j * stride
                y1, x1 = min(y0 + crop, ph), min(x0 + crop, pw)
                output = one_window(pad(padded[:, y0:y1, x0:x1], crop, crop), head, flip)
                full = np.zeros((len(output), ph, pw))
                full[:, y0:y1, x0:x1] = output[:, : y1 - y0, : x1 - x0]
                total_here = total_here + full
                count[y0:y1, x0:x1] += 1
        total = total + resize((total_here / count)[:, :height, :width], h, w)
    return total
