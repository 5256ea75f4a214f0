"""Every CPU engine against float64 brute force, over hundreds of random scenes with near-degenerate Gaussians.

What is compared, with u the rounding unit of the engine's dtype:

- maps and alphas at every pixel: within `MAPS` of the largest |map| of the scene (of 1 for alphas), plus an allowance for
  that pixel: what follows if alphas are off by 4 u times what cancels among the terms of their power (needles, far from
  their means), and, where within 16 roundings alpha lies on 1/255 or T' on 1e-4, what the other decision would change;
- gradients for a random cotangent: within `GRADIENTS` of the input's largest |gradient| in the scene, plus the sum of its
  |contributions| times 16 u and what cancels. An engine whose backward pass starts from the maps and alphas of the forward
  pass knows what lies behind a Gaussian to a rounding of the whole: 4 u of that, times alpha / (1 - alpha), is allowed.
  Pixels on a threshold (1/255, 1e-4, or the clamp at 0.99) get no cotangent: there the gradient jumps. Their share is
  asserted to be below 1 %;
- in scenes without a Gaussian more than 20 times longer than wide: maps and alphas off the thresholds, and the gradients
  of features, within `MAPS` and `GRADIENTS` with no allowance at all, and so the other gradients in 9 of 10 scenes;
- sums of `accumulate_pixels` as the gradients of features, its weights likewise.

Binning is part of the comparison: the oracle tries every Gaussian at every pixel.
"""

from typing import NamedTuple

import numpy as np
import oracles_accuracy as oracle
import oracles_splat
import pytest
import torch

from kfgs.splat import Projected, accumulate_pixels, available_engines, bin_tiles, composite

MAPS = {torch.float32: 1e-5, torch.float64: 1e-10}
GRADIENTS = {torch.float32: 1e-4, torch.float64: 1e-8}
UNIT = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
BLOCK = 50  # scenes in one test
BLOCKS = {"numba": 10, "reference": 2}  # 500 scenes of the engine that people get; float64 takes a tenth
RESULTS = ("maps", "alphas", *oracle.Gradients._fields, "sums", "weights")
CHANNELS = (1, 3, 9, 10, 11, 16, 27, 40)
KINDS = ("ordinary", "needle", "huge", "tiny", "opaque", "faint", "outside")


ENGINES = available_engines("cpu")


# scenes ---------------------------------------------------------------------------------------------------------------


class Case(NamedTuple):
    seed: int
    scene: oracle.Scene
    tile_size: int
    index: np.ndarray | None  # the rows of a larger array that the scene's features are
    count: int  # rows of that array


def _tiles(case):
    """Binned in float32, from the extents of the footprints."""
    scene = case.scene
    a, b, c = scene.conics.T
    reach = 2 * np.log(255 * scene.opacities.clip(min=1 / 255))
    extents = np.sqrt(reach / (a * c - b * b))[:, None] * np.sqrt(np.stack([c, a], 1))
    values = (torch.from_numpy(v).float() for v in (*scene[:4], extents))
    return bin_tiles(Projected(*values, torch.arange(len(a))), scene.width, scene.height, case.tile_size)


def _case(seed):
    """1 to 60 Gaussians of some of the kinds (or none), whose numbers are float32."""
    g = np.random.default_rng(seed)
    width, height = int(g.integers(20, 41)), int(g.integers(14, 25))
    M = int(g.integers(1, 61)) if g.random() > 0.02 else 0
    kind = g.choice(g.choice(KINDS, 1 + g.integers(len(KINDS))), M)
    sigmas = g.uniform(0.7, 6.0, (M, 2))
    needle, huge, tiny = kind == "needle", kind == "huge", kind == "tiny"
    sigmas[needle, 0] = g.uniform(0.3, 1.0, needle.sum())
    sigmas[needle, 1] = sigmas[needle, 0] * 10 ** g.uniform(1, 3, needle.sum())
    sigmas[huge] = g.uniform(50, 500, (huge.sum(), 2))
    sigmas[tiny] = g.uniform(0.05, 0.5, (tiny.sum(), 2))
    opacities = g.uniform(0.05, 0.95, M)
    opacities = np.where(kind == "opaque", g.uniform(0.985, 1.0, M), opacities)
    opacities = np.where(kind == "faint", np.exp(g.normal(0, 0.5, M)) / 255, opacities)
    if M and g.random() < 0.2:  # a stack that stops
        sigmas[: M // 2], opacities[: M // 2] = g.uniform(8, 40, (M // 2, 2)), g.uniform(0.4, 1.0, M // 2)

    means2d = g.uniform(-1, 1, (M, 2)) * (width / 2 + 3, height / 2 + 3) + (width / 2, height / 2)
    angle = g.uniform(0, np.pi, M) * (g.random(M) > 0.1)  # some lie along the axes
    along = np.stack([-np.sin(angle), np.cos(angle)], 1)
    means2d += along * (sigmas[:, 1] * g.uniform(-2, 2, M) * (needle | (kind == "outside")))[:, None]
    on_center = g.random(M) < 0.1
    means2d[on_center] = np.floor(means2d[on_center]) + 0.5
    depths = g.uniform(1, 10, M)
    depths[g.random(M) < 0.3] = 5.0
    cos, sin = np.cos(angle), np.sin(angle)
    p, q = sigmas.T**-2.0
    conics = np.stack([p * cos**2 + q * sin**2, (p - q) * cos * sin, p * sin**2 + q * cos**2], 1)
    channels = int(g.choice(CHANNELS))
    index, count = None, M
    if g.random() < 0.5:  # what is seen of more, in order as `project` gives it, or any of them, several times
        count = M + int(g.integers(1, 20))
        index = np.sort(g.permutation(count)[:M]) if g.random() < 0.5 else g.integers(0, count, M)
    features = g.normal(0, 1, (count, channels)) * 10 ** g.uniform(-2, 2)
    features = features if index is None else features[index]
    background = g.normal(0, 1, channels) * (g.random() < 0.5) * 10 ** g.uniform(-2, 1)
    values = (means2d, conics, depths, opacities, features, background)
    values = [v.astype(np.float32).astype(np.float64) for v in values]
    conics = values[1]
    assert (conics[:, 0] * conics[:, 2] > conics[:, 1] ** 2).all()
    scene, tile_size = oracle.Scene(*values, width, height), int(g.choice([16, 16, 16, 8, 7, 32]))
    return Case(seed, scene, tile_size, index, count)


def _cotangents(seen, scene, seed):
    """Random and float32, zero where a threshold makes the gradient jump; flat as the oracle has it."""
    g = np.random.default_rng(seed)
    smooth = ~(seen.on_threshold | seen.on_clamp)
    maps = g.normal(0, 1, seen.maps.shape) * smooth[:, None]
    alphas = g.normal(0, 1, len(smooth)) * smooth
    return maps.astype(np.float32).astype(np.float64), alphas.astype(np.float32).astype(np.float64)


def _spread(case, values):
    """Values [M, D] of the scene's rows of features, as sums in the rows [N, D] of the array that they come from."""
    if case.index is None:
        return values
    out = np.zeros((case.count, values.shape[1]))
    np.add.at(out, case.index, values)
    return out


def _table(case):
    """The array [N, D] that the scene's features come from."""
    if case.index is None:
        return case.scene.features
    table = np.full((case.count, case.scene.features.shape[1]), 1e3)  # nothing else may be read
    table[case.index] = case.scene.features
    return table


def _run(case, dtype, engine, cotangents):
    """maps [H * W, D], alphas [H * W], the five gradients, and the sums and weights of the first cotangent."""
    scene, tiles = case.scene, _tiles(case)
    inputs = scene.means2d, scene.conics, scene.opacities, _table(case), scene.background
    inputs = [torch.from_numpy(v).to(dtype).requires_grad_() for v in inputs]
    index = None if case.index is None else torch.from_numpy(case.index)
    maps, alphas = composite(*inputs[:4], tiles, background=inputs[4], index=index, engine=engine)
    upstream = [torch.from_numpy(v).to(dtype).view(o.shape) for v, o in zip(cotangents, (maps, alphas), strict=True)]
    grads = torch.autograd.grad((maps, alphas), inputs, upstream)
    splats = [v.detach() for v in inputs[:3]]
    sums, weights = accumulate_pixels(*splats, upstream[0], tiles, engine=engine)
    return maps.detach().flatten(0, 1), alphas.detach().flatten(), *grads, sums, weights


# the comparison -------------------------------------------------------------------------------------------------------


class Compared(NamedTuple):
    """How one scene came out."""

    excess: dict[str, float]  # of each result: its error over what is allowed
    plain: set[str]  # what passes without any allowance, but for the pixels on a threshold
    on_edge: int  # pixels on a threshold


def _compare(case, dtype, engine):
    """Compare the engine's results with the oracle's."""
    scene, unit = case.scene, UNIT[dtype]
    seen = oracle.composite(scene, unit)
    cotangents = _cotangents(seen, scene, case.seed)
    grads, allowed = oracle.differentiate(scene, seen, cotangents, unit, from_outputs=engine != "reference")
    sums, weights = oracle.accumulate(scene, seen, cotangents[0])
    largest = max(np.abs(scene.features).max(initial=0), np.abs(scene.background).max())
    sum_allowance = allowed.features
    grads, allowed = (v._replace(features=_spread(case, v.features)) for v in (grads, allowed))
    expected = (seen.maps, seen.alphas, *grads, sums, weights)
    allowances = (2 * largest * seen.allowance[:, None], seen.allowance, *allowed, sum_allowance, seen.allowance.sum())
    actual = _run(case, dtype, engine, cotangents)
    excess, plain = {}, set()
    for name, a, e, allowance in zip(RESULTS, actual, expected, allowances, strict=True):
        error = np.abs(a.double().numpy() - e)
        assert np.isfinite(error).all(), f"{engine}, {dtype}, seed {case.seed}: {name} is not finite"
        limit = (MAPS if name in ("maps", "alphas") else GRADIENTS)[dtype]
        limit *= 1 if name == "alphas" else np.abs(e).max(initial=0)
        excess[name] = _ratio(error, limit + allowance)
        if name in ("maps", "alphas"):
            error = error[~seen.on_threshold]
        if _ratio(error, limit) <= 1:
            plain.add(name)
    return Compared(excess, plain, int((seen.on_threshold | seen.on_clamp).sum()))


def _ratio(error, limit):
    """The largest error / limit; 0 / 0 is 0."""
    limit = np.broadcast_to(limit, error.shape)
    return float(np.divide(error, limit, out=np.where(error > 0, np.inf, 0.0), where=limit > 0).max(initial=0))


def _has_needles(scene):
    """Whether some Gaussian is more than 20 times longer than wide."""
    a, b, c = scene.conics.T
    middle, product = (a + c) / 2, a * c - b * b
    largest = middle + np.sqrt(np.maximum(middle**2 - product, 0))  # eigenvalue; the other is product / largest
    return bool((largest > 20**2 * product / largest).any())


def _assert_accurate(seeds, dtype, engine):
    on_edge = pixels = round_scenes = plain = 0
    for seed in seeds:
        case = _case(seed)
        compared = _compare(case, dtype, engine)
        name, excess = max(compared.excess.items(), key=lambda item: item[1])
        assert excess <= 1, f"{engine}, {dtype}, seed {seed}: {name} is off by {excess:.3g} times what is allowed"
        on_edge, pixels = on_edge + compared.on_edge, pixels + case.scene.width * case.scene.height
        if not _has_needles(case.scene):
            missing = {"maps", "alphas", "features", "sums"} - compared.plain
            assert not missing, f"{engine}, {dtype}, seed {seed}: {missing} off by more than {MAPS[dtype]:g}"
            round_scenes += 1
            plain += {"means2d", "conics", "opacities"} <= compared.plain
    if len(seeds) == BLOCK:
        assert on_edge <= 0.01 * pixels
        assert plain >= 0.9 * round_scenes > 10


SHARES = [(engine, block) for engine in ENGINES for block in range(BLOCKS.get(engine, 1))]


@pytest.mark.parametrize(("engine", "block"), SHARES)
def test_float32_is_as_accurate_as_its_rounding(engine, block):
    count = BLOCK if engine in BLOCKS else 4  # an interpreted kernel takes seconds a scene
    _assert_accurate(range(BLOCK * block, BLOCK * block + count), torch.float32, engine)


@pytest.mark.parametrize(("engine", "block"), [(e, b) for e, b in SHARES if e in BLOCKS and b % 10 == 0])
def test_float64_is_as_accurate_as_its_rounding(engine, block):
    _assert_accurate(range(10_000 + BLOCK * block, 10_000 + BLOCK * (block + 1)), torch.float64, engine)


# the test itself ------------------------------------------------------------------------------------------------------


def test_oracle_agrees_with_the_one_written_pixel_by_pixel():
    for case in map(_case, range(500, 512)):
        scene = case.scene
        expected = oracles_splat.composite(*scene[:5], scene.width, scene.height, scene.background)
        seen = oracle.composite(scene, 2.0**-53)
        smooth = ~seen.on_threshold
        assert smooth.mean() > 0.99
        for actual, truth in zip((seen.maps, seen.alphas[:, None]), expected, strict=True):
            error = np.abs(actual - truth.reshape(actual.shape))
            limit = (1e-13 + 2 * seen.allowance[:, None]) * (1 + np.abs(truth).max())
            assert (error <= limit)[smooth].all(), f"seed {case.seed}"
