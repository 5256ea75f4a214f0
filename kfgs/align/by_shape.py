"""The similarity between two clouds of one scene, from their shape alone.

The search starts from a few thousand rotations and sizes. It improves all of them together on a lookup grid of nearest points
(coarse), then the best few by least squares on point-to-plane distances (fine). The best fit must be clearly better than the
second best. Distances count both ways, so shrinking one cloud into the other, or enlarging it, brings no advantage.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .._check import check_shapes
from .._typed import typed
from ..cameras.similarity import Similarity
from ..scenes.files import SceneError
from .by_cameras import Alignment
from .close_fit import Cloud, Fit, fit_closely
from .clouds import Array, bulk, nearest_rotation, to_similarity
from .starts import Moves, improve_on_grid, principal_axes, spread_rotations, thin

ROTATIONS = 576  # evenly over all rotations: about 16 degrees from any rotation to the nearest, in the middle
SIZES = (0.75, 0.87, 1.0, 1.15, 1.33)  # around the ratio of the clouds' radii, which partial overlap distorts
BASINS, FINALISTS = 8, 3  # starts that are refined, and starts that are refined on more points
COARSE, FINE, FULL = 300, 3_000, 10_000  # points of each cloud
MIN_FIT = 0.6  # of the points, both ways (harmonic mean)
MARGIN = 0.6  # the second best fit must leave more than 1 / MARGIN times as many points unfit as the best


@typed
def align_clouds(
    src: Tensor,  # [N, 3]
    dst: Tensor,  # [M, 3]
    *,
    generator: torch.Generator | None = None,
) -> Alignment:
    """Find the rotation, translation and scale that lay one cloud onto another of the same scene.

    The clouds may differ in density, noise and floaters, and overlap in part (about three quarters of each in the
    other). A point fits when it is closer to the other cloud than 2 spacings of the sparser one; `quality` is the
    harmonic mean of the shares of points that fit, both ways.

    Args:
        src: points in the source frame, finite; leave out Gaussians too faint to see.
        dst: points in the destination frame.
        generator: draws the points that the search uses; None: seed 0.

    Returns:
        The similarity from the source frame to the destination frame; `details` holds both shares, the quality, and the
        quality of the best other fit (another rotation, size or place).

    Raises:
        SceneError: if nothing fits well, or two different fits are about equally good (the scene is symmetric).
        ValueError: if shapes disagree, there are too few points, or a number is not finite.

    Note:
        Five to ten seconds on one core. The scene must have a shape: a bare box looks the same after half a turn.
    """
    check_shapes(("src", src, "N 3"), ("dst", dst, "M 3"))
    seed = 0 if generator is None else int(torch.randint(2**31, (1,), generator=generator))
    rng = np.random.default_rng(seed)
    a, b = bulk("src", src, 60_000), bulk("dst", dst, 60_000)
    for name, cloud in (("src", a), ("dst", b)):
        if len(cloud) < 100 or np.linalg.svd(cloud - cloud.mean(0), compute_uv=False)[2] < 1e-6 * np.ptp(cloud):
            raise SceneError(
                f"{name}: expected at least 100 points that fill space, got {len(cloud)}; align by cameras instead"
            )
    size = float(np.linalg.norm(np.ptp(b, axis=0)))
    starts, fits = _starts(a, b, rng), []
    for count, reaches, kept in ((FINE, np.geomspace(4, 1, 20), FINALISTS), (FULL, np.geomspace(1, 0.5, 10), 2)):
        x, y = Cloud.of(a, count, rng), Cloud.of(b, count, rng)
        fits = sorted((fit_closely(x, y, start, reaches) for start in starts), key=lambda fit: -fit.quality)
        starts = _different([fit.similarity for fit in fits], a.mean(0), size, kept)
    best = fits[0]
    runner_up = max((fit.quality for fit in fits if fit.similarity in starts[1:]), default=0.0)
    _check_fit(best, runner_up)
    details = {
        "source points that fit": best.shares[0],
        "destination points that fit": best.shares[1],
        "quality": best.quality,
        "best other fit": runner_up,
    }
    inliers = round(best.shares[0] * len(x.points) + best.shares[1] * len(y.points))
    how = f"shape of the clouds (quality {best.quality:.2f}, next best {runner_up:.2f})"
    return Alignment(best.similarity, best.rms, size, inliers, len(x.points) + len(y.points), how, details)


def _check_fit(best: Fit, runner_up: float) -> None:
    """Refuse a bad or an ambiguous fit."""
    if best.quality < MIN_FIT:
        raise SceneError(
            f"clouds: expected at least {MIN_FIT:.0%} of the points to fit, got {best.quality:.0%} "
            f"({best.shares[0]:.0%} of the source, {best.shares[1]:.0%} of the destination) with the best similarity "
            "found; are they of the same scene? Align by cameras of the same names, or pass the similarity"
        )
    if 1 - best.quality > MARGIN * (1 - runner_up):
        raise SceneError(
            f"clouds: expected one similarity that fits best, got two that fit equally well (quality {best.quality:.3f} and "
            f"{runner_up:.3f}): a symmetric shape, or not of the same scene. Align by cameras of the same names, or pass "
            "the similarity"
        )


def _starts(a: Array, b: Array, rng: np.random.Generator) -> list[Similarity]:
    """The best basins of a search over all rotations and some sizes, most promising first."""
    clouds = [thin(cloud, COARSE * 3, rng) for cloud in (a, b)]
    centers = [cloud.mean(0) for cloud in clouds]
    radii = [
        float(np.sqrt(((cloud - center) ** 2).sum(1).mean())) for cloud, center in zip(clouds, centers, strict=True)
    ]
    x, y = ((cloud - center) / radius for cloud, center, radius in zip(clouds, centers, radii, strict=True))
    rotations = np.concatenate([principal_axes(x, y), spread_rotations(ROTATIONS)])
    moves = Moves.of(rotations, SIZES)
    moves, scores = improve_on_grid(x, y, moves, COARSE, rng)
    order = np.argsort(-scores)[: 50 * BASINS]
    found = []
    for i in order:
        R, s = nearest_rotation(moves.rotations[i]), float(moves.scales[i]) * radii[1] / radii[0]
        t = centers[1] + radii[1] * moves.translations[i] - s * R @ centers[0]
        found.append(to_similarity(s, R, t))
    return _different(found, centers[0], 2 * radii[1], BASINS)


def _different(similarities: list[Similarity], center: Array, size: float, count: int) -> list[Similarity]:
    """The first `count` that are different answers: 10 degrees, 10 % in size, or a tenth of the scene apart."""
    chosen: list[Similarity] = []
    for one in similarities:
        if len(chosen) < count and all(_differs(one, other, center, size) for other in chosen):
            chosen.append(one)
    return chosen


def _differs(one: Similarity, other: Similarity, center: Array, size: float) -> bool:
    cosine = (float((one.rotation * other.rotation).sum()) - 1) / 2
    places = [similarity.apply(torch.from_numpy(center)[None])[0] for similarity in (one, other)]
    shift = float((places[0] - places[1]).norm())
    return cosine < np.cos(np.radians(10)) or abs(np.log(one.scale / other.scale)) > 0.1 or shift > 0.1 * size
