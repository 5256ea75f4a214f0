"""How much work and memory each stage of a run takes, as formulas of its sizes with measured constants.

Work is counted in operations of a large float32 matrix product: what a stage takes in seconds, times the speed that such a
product had in the same process. So the constants carry over to a machine of another speed, as far as its memory keeps up.
They were measured by `benchmarks/plan_constants.py` on 2026-11-21, on 2 shared cores of a Xeon with AVX-512 (torch 2.13,
420 GFLOP/s when quiet), rounded, and those of field and autoencoder raised to what whole runs of room_0 and the toy room
took. A busy machine slows the product more than it slows stages that wait for memory, so times are foretold too long there;
one with many more cores will find them too short, since not every stage divides among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from ..fields import FieldConfig
from ..quant import AutoencoderConfig, CodebookConfig

FEATURES_EFFICIENCY = 0.5
"""Share of the matrix product's speed that a vision transformer reaches (its convolutions, norms and softmax included)."""
PICTURE_WORK = 2e10
"""Per picture: reading, resizing, digests."""
WRITE_WORK = 800.0
"""Per number of a dense map: rounding it to half precision, writing and digesting it."""
READ_WORK = 900.0
"""Per number of a map that is read in half precision and made a float32 one."""
LOOK_WORK = 150.0
"""The paper's codebook, per number of a sample: norms, balance of classes, gradient (Eq. 6-9)."""
LOOK_CODEWORD_WORK = 5.5
"""The same, per number and codeword: similarities (Eq. 5)."""
FARTHEST_EFFICIENCY = 0.45
"""Share of the product's speed in the all-pairs similarities of farthest-point sampling."""
GROW_WORK = 3.5e4
"""Adaptive codebook, per number of the pool: k-means, widest directions and trial splits of all rounds (measured
on 2 shared cores of an EPYC, which were busy: 49,000, and 108 per codeword)."""
GROW_CODEWORD_WORK = 100.0
"""The same, per number and codeword."""
QUANTIZE_WORK = 250.0
"""Index maps, per number of a map: norms and checks."""
QUANTIZE_CODEWORD_WORK = 2.5
"""The same, per number and codeword."""
AUTOENCODER_WEIGHT_WORK = 1_500.0
"""Autoencoder, per weight and step, by the speed of all threads: Adam, on one thread."""
AUTOENCODER_ROW_WORK = 8.0
"""The same, per weight, step and codeword: the products."""
STEP_WORK = 2.8e9
"""Field, per step: Python, small kernels."""
STEP_PIXEL_WORK = (8.0e3, 2.8e3)
"""The same, per rendered pixel: a constant, and per channel."""
STEP_GAUSSIAN_WORK = (5.0e3, 2.0e3)
"""The same, per Gaussian."""
STEP_TARGET_WORK = 2.0e3
"""The same, per number of the target map."""
GPU_FEATURES_EFFICIENCY = 0.4
"""Assumed, not measured: share of the GPU's own float32 product that a vision transformer reaches."""
GPU_STEP_SECONDS = 0.005
"""Assumed, not measured: the least a step of the field takes on a GPU, where launching kernels takes longest."""

BASE_BYTES = 450_000_000
"""Python, torch, kornia and a scene (measured: 381 MB)."""
KERNELS_BYTES = 250_000_000
"""What the field's compiled kernels take beside it."""
GROWTH = {"dense": 6.0, "sparse": 1.15}
"""How many times more Gaussians than points training ends with: at a densification gradient below 4e-4, from the paper's
110.5k (Table 2, 9 channels) against the 18.5k points of room_0; above it, from room_0 and the toy room with the CPU preset."""


def features_work(flops: float, pictures: int, written: float) -> float:
    """Encoding pictures with so many operations in all, and writing so many numbers."""
    return flops / FEATURES_EFFICIENCY + pictures * PICTURE_WORK + written * WRITE_WORK


def codebook_work(config: CodebookConfig, samples: float, first: int, channels: int) -> float:
    """Fitting the codebook.

    Args:
        config: its size, and whether it is fitted as in the paper.
        samples: features that are looked at in one pass, all maps together.
        first: samples of the first map, from which the paper's first codewords are chosen.
        channels: D.
    """
    numbers, K = samples * channels, config.maximum
    read = config.passes * numbers * READ_WORK
    if config.adaptive:
        return read + numbers * (GROW_WORK + GROW_CODEWORD_WORK * K)
    looks = numbers * config.passes * (LOOK_WORK + LOOK_CODEWORD_WORK * K)
    return read + looks + float(first) ** 2 * channels / FARTHEST_EFFICIENCY


def quantize_work(pixels: float, channels: int, codewords: int) -> float:
    """Reading all maps once, and finding each pixel's codeword."""
    return pixels * channels * (READ_WORK + QUANTIZE_WORK + QUANTIZE_CODEWORD_WORK * codewords)


def autoencoder_weights(config: AutoencoderConfig, channels: int) -> int:
    """Weights and biases of encoder and decoder."""
    encoder, decoder = (channels, *config.encoder, config.latent), (config.latent, *config.decoder, channels)
    return sum((a + 1) * b for widths in (encoder, decoder) for a, b in pairwise(widths))


def autoencoder_work(config: AutoencoderConfig, channels: int, codewords: int) -> float:
    """All steps; each takes all codewords and some blends of them."""
    per_weight = AUTOENCODER_WEIGHT_WORK + AUTOENCODER_ROW_WORK * (codewords + config.blends)
    return config.steps * autoencoder_weights(config, channels) * per_weight


def step_work(pixels: float, gaussians: float, channels: int, target: float) -> float:
    """One step of the field: rendering, loss, gradients and Adam. `target` is the pixels of the map compared with."""
    by_pixel = STEP_PIXEL_WORK[0] + STEP_PIXEL_WORK[1] * channels
    by_gaussian = STEP_GAUSSIAN_WORK[0] + STEP_GAUSSIAN_WORK[1] * channels
    return STEP_WORK + pixels * by_pixel + gaussians * by_gaussian + target * channels * STEP_TARGET_WORK


def render_pixels(config: FieldConfig, camera: tuple[int, int], target: tuple[int, int]) -> float:
    """Pixels that are rendered for a camera of (height, width) pixels and a map of (h, w), mean over the steps."""
    if config.render_scale is not None:
        h, w = (min(max(1, round(n * config.render_scale)), c) for n, c in zip(target, camera, strict=True))
        return float(h * w)
    total, before = 0.0, 0
    for last, divisor in (*config.coarse, (config.steps, 1)):
        until = min(last, config.steps)
        total += max(0, until - before) / divisor**2
        before = max(before, until)
    return camera[0] * camera[1] * total / config.steps


def gaussian_counts(config: FieldConfig, points: int) -> tuple[float, int]:
    """Mean number of Gaussians over the steps, and the last one: a guess (`GROWTH`), growing evenly while it densifies."""
    until = min(config.densify_until, config.steps)
    if until <= config.densify_from:
        return float(points), points
    last = round(points * GROWTH["dense" if config.densify_gradient < 4e-4 else "sparse"])
    if config.max_gaussians is not None:
        last = max(points, min(last, config.max_gaussians))
    after, during = config.steps - until, until - config.densify_from
    return (config.densify_from * points + during * (points + last) / 2 + after * last) / config.steps, last


def field_bytes(gaussians: int, channels: int) -> int:
    """Mean, rotation, scale, opacity and features of so many Gaussians, in float32."""
    return 4 * gaussians * (11 + channels)


def codebook_peak(samples: int, channels: int, codewords: int, *, adaptive: bool) -> int:
    """Samples of one map (four arrays of them), similarities, and the first map's pairs by blocks of 2048 rows; adaptive:
    the samples of all maps, and no pairs.

    Measured beyond the base: 600 MB for the paper's 28,800 samples of 512 channels, where this gives 742.
    """
    pairs = 0 if adaptive else 2 * min(2048, samples) * samples
    return 4 * (4 * samples * channels + 3 * samples * codewords + pairs)


def field_peak(pixels: float, gaussians: int, channels: int, targets: Sequence[int]) -> int:
    """Parameters with gradients and moments, three maps of the rendered size, and what holds the targets.

    Measured beyond the base at 639x479 and 18.5k Gaussians: 350 MB for 9 channels, 2.5 GB for 512; this gives 0.4 and 3.1.
    """
    maps = 3 * 4 * pixels * (channels + 2)
    return KERNELS_BYTES + int(8 * field_bytes(gaussians, channels) + maps + sum(targets))
