"""The similarity between two frames of one scene, from the cameras that have the same names in both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import torch

from .._files import file_stem, folded_name
from .._typed import typed
from ..cameras import Camera
from ..cameras.similarity import Similarity, fit_similarity
from ..scenes.files import SceneError, some
from ..scenes.pycolmap_import import quiet_pycolmap
from .clouds import Array, nearest_rotation, to_similarity

MAX_ERROR = 0.03  # of the cameras' extent: two SfM runs of one scene differ by well below a hundredth
MAX_ANGLE = 15.0  # degrees between a camera's two orientations, after alignment
MIN_INLIERS = 0.5  # share of the common cameras that must fit
TRIPOD = 0.01  # cameras closer together than this share of the extent stand at one place
ROUNDING = 1e-4  # of the extent: poses in float32 may be off by that, where the frame stands far from its origin
SIGMAS = 4.0  # in the last fits, cameras farther off than this many median distances are left out
PAIRS = 5_000  # pairs of cameras tried when their centres alone say too little


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity that brings a source frame onto a destination frame, and how well it fits."""

    similarity: Similarity
    """x_dst = scale R x_src + t."""
    rms: float
    """Root mean square distance of the inliers, world units of the destination."""
    size: float
    """Extent of the compared cameras (or points) in the destination, world units."""
    inliers: int
    """Cameras (or points) that fit."""
    count: int
    """Cameras (or points) that were compared."""
    how: str
    """How it was found, in words."""
    details: dict[str, Any] = field(default_factory=dict)
    """More numbers as JSON, for instance the worst cameras by name."""

    def __repr__(self) -> str:
        return f"Alignment({self.summary})"

    @property
    def summary(self) -> str:
        """One sentence: how it was found, the scale, how many fit and how closely."""
        return (
            f"{self.how}: scale {self.similarity.scale:.6g}, {self.inliers} of {self.count} fit, rms {self.rms:.3g} "
            f"({self.rms / self.size:.2%} of the extent {self.size:.3g})"
        )

    def to_json(self) -> dict[str, Any]:
        """The similarity's matrix and every number, as plain lists and floats."""
        return {
            "how": self.how,
            "matrix": self.similarity.matrix().tolist(),
            "scale": float(self.similarity.scale),
            "rms": self.rms,
            "rms of extent": self.rms / self.size,
            "inliers": self.inliers,
            "count": self.count,
            **self.details,
        }


@typed
def align_by_cameras(src: Sequence[Camera], dst: Sequence[Camera]) -> Alignment:
    """The similarity between two reconstructions of the same pictures, from the cameras that have the same names.

    Wrong poses are left out as long as half of the common cameras agree. Candidates come from the centres alone
    (pycolmap's LO-RANSAC), and from the orientations with pairs of centres. The candidate that most cameras agree with, in
    place and in orientation, is refined on these cameras by least squares.

    Args:
        src: posed cameras in the source frame; distortion and intrinsics are not used.
        dst: posed cameras in the destination frame.

    Returns:
        The similarity from the source frame to the destination frame; `details` names the cameras that fit worst.

    Raises:
        SceneError: if fewer than two names are common, all common cameras stand at one place (no scale follows), or
            fewer than half agree on one similarity.

    Note:
        Names are compared without folder and suffix ("images/a.JPG" is "a.png"), unless names repeat without folders.
        Three cameras that do not stand on a line need no orientations; two cameras, or a row of them, do.
    """
    pairs = common_cameras(src, dst)
    names = [file_stem(a.name) for a, _ in pairs]
    origins = pairs[0][0].origin, pairs[0][1].origin
    A, B = (np.stack([_center(pair[k].to(torch.float64).with_origin(origins[k])) for pair in pairs]) for k in (0, 1))
    turns = np.stack([_rotation(b).T @ _rotation(a) for a, b in pairs])  # [V, 3, 3] source world to destination world
    sizes = _extents(B)
    if min(sizes[0] / max(1.0, np.abs(B).max()), _extents(A)[0] / max(1.0, np.abs(A).max())) < 1e-9:
        raise SceneError(
            f"cameras: expected common cameras at different places, got {len(pairs)} at one ({some(names)}), from which "
            "no scale follows; give more views, or pass the similarity"
        )
    similarity, good, size = _best_fit(A, B, turns, sizes)
    if similarity is None or good.sum() < _least(A):
        raise SceneError(
            f"cameras: expected at least half of the {len(pairs)} common cameras to fit one similarity, got "
            f"{int(good.sum())}; check that the names mean the same pictures in both, or pass the similarity"
        )
    errors = _distances(similarity, A, B)
    worst = [names[i] for i in np.argsort(-errors)[:5]]
    details = {
        "worst cameras": {name: float(errors[names.index(name)]) for name in worst},
        "left out": [name for name, ok in zip(names, good, strict=True) if not ok],
        "median angle": float(np.median(_angles(similarity, turns)[good])),
    }
    rms = float(np.sqrt((errors[good] ** 2).mean()))
    similarity = similarity.between_worlds(*origins)
    return Alignment(similarity, rms, size, int(good.sum()), len(pairs), "cameras of the same names", details)


def common_cameras(src: Sequence[Camera], dst: Sequence[Camera]) -> list[tuple[Camera, Camera]]:
    """Pairs of cameras of the same name, in the order of `src`; `align_by_cameras` says when names are the same."""
    keys = _keys(src, dst, lambda camera: PurePosixPath(folded_name(file_stem(camera.name))).name)
    keys = keys or _keys(src, dst, lambda camera: folded_name(file_stem(camera.name)))
    keys = keys or _keys(src, dst, lambda camera: file_stem(camera.name)) or ({}, {})
    pairs = [(camera, keys[1][key]) for key, camera in keys[0].items() if key in keys[1]]
    if len(pairs) < 2:
        raise SceneError(
            f"cameras: expected at least two names that both have, got {len(pairs)} (source: "
            f"{some([c.name for c in src], 3)}; destination: {some([c.name for c in dst], 3)}); give both the names of "
            "their pictures, or align the clouds"
        )
    return pairs


def _keys(src: Sequence[Camera], dst: Sequence[Camera], key: Any) -> tuple[dict[str, Camera], dict[str, Camera]] | None:
    tables = {key(camera): camera for camera in src}, {key(camera): camera for camera in dst}
    return tables if len(tables[0]) == len(src) and len(tables[1]) == len(dst) else None


def _best_fit(A: Array, B: Array, turns: Array, sizes: list[float]) -> tuple[Similarity | None, Array, float]:
    """The similarity that most cameras agree with, these cameras, and the first size for which half of all cameras agree."""
    best: tuple[Similarity | None, Array, float] = (None, np.zeros(len(A), dtype=bool), sizes[0])
    for size in sizes:
        for start in (_by_centers(A, B, size), *_by_orientations(A, B, turns, size)):
            if start is not None:
                similarity, good = _refine(start, A, B, turns, size)
                spread = np.ptp(B[good], axis=0).max(initial=0.0) if good.any() else 0.0
                if spread > TRIPOD * size and good.sum() > best[1].sum():  # at one place any scale fits
                    best = similarity, good, size
        if best[1].sum() >= _least(A):
            break
    return best


def _least(A: Array) -> float:
    return max(2, MIN_INLIERS * len(A))


def _by_centers(A: Array, B: Array, size: float) -> Similarity | None:
    """LO-RANSAC over triples of centres; None if they stand on a line or none fits."""
    if len(A) < 3:
        return None
    with quiet_pycolmap() as pycolmap:
        options = pycolmap.RANSACOptions()
        options.max_error, options.random_seed = MAX_ERROR * size, 0
        found = pycolmap.estimate_sim3d_robust(A, B, options)
    if found is None or not found["tgt_from_src"].scale > 0:
        return None
    fit = found["tgt_from_src"]
    return to_similarity(fit.scale, fit.rotation.matrix(), fit.translation)


def _by_orientations(A: Array, B: Array, turns: Array, size: float) -> list[Similarity]:
    """The rotation that most cameras' orientations agree on, then scale and translation from the best pair of centres."""
    cosines = (np.einsum("iab,jab->ij", turns, turns) - 1) / 2
    near = cosines > np.cos(np.radians(MAX_ANGLE))
    row = near[int(near.sum(1).argmax())]
    R = nearest_rotation(turns[row].sum(0))
    turned = A[row] @ R.T  # [n, 3]
    i, j = np.triu_indices(int(row.sum()), 1)
    if len(i) == 0:
        return []
    chosen = np.random.default_rng(0).permutation(len(i))[:PAIRS]
    i, j = i[chosen], j[chosen]
    base, other = turned[j] - turned[i], B[row][j] - B[row][i]
    scales = (base * other).sum(1) / np.maximum((base**2).sum(1), 1e-300)
    best, most = None, 0
    for scale, first in zip(scales, i, strict=True):
        if scale > 0:
            shift = B[row][first] - scale * turned[first]
            fits = int((np.linalg.norm(scale * turned + shift - B[row], axis=1) < MAX_ERROR * size).sum())
            if fits > most:
                best, most = to_similarity(scale, R, shift), fits
    return [] if best is None else [best]


def _refine(start: Similarity, A: Array, B: Array, turns: Array, size: float) -> tuple[Similarity, Array]:
    """Least squares over the cameras that fit, repeated until they stay the same; gives the fit and these cameras."""
    similarity, limit = start, MAX_ERROR * size
    good = _good(similarity, A, B, turns, limit)
    for _ in range(10):
        if good.sum() < 2:
            break
        if _on_a_line(A[good]):
            similarity = _fit_on_a_line(A[good], B[good], turns[good])
        else:
            similarity = fit_similarity(torch.from_numpy(A[good]), torch.from_numpy(B[good]))
        typical = float(np.median(_distances(similarity, A, B)[good]))
        limit = min(MAX_ERROR * size, SIGMAS * typical + ROUNDING * size)
        before, good = good, _good(similarity, A, B, turns, limit)
        if bool((good == before).all()):
            break
    return similarity, good


def _fit_on_a_line(A: Array, B: Array, turns: Array) -> Similarity:
    """Rotation from the orientations, scale and translation from the centres."""
    R = nearest_rotation(turns.sum(0))
    a, b = (A - A.mean(0)) @ R.T, B - B.mean(0)
    scale = float((a * b).sum() / (a**2).sum())
    return to_similarity(scale, R, B.mean(0) - scale * R @ A.mean(0))


def _on_a_line(points: Array) -> bool:
    widths = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return len(points) < 3 or bool(widths[1] < 1e-3 * widths[0])


def _good(similarity: Similarity, A: Array, B: Array, turns: Array, limit: float) -> Array:
    good: Array = (_distances(similarity, A, B) <= limit) & (_angles(similarity, turns) <= MAX_ANGLE)
    return good


def _distances(similarity: Similarity, A: Array, B: Array) -> Array:
    moved: Array = similarity.apply(torch.from_numpy(A)).numpy()
    return np.linalg.norm(moved - B, axis=1)


def _angles(similarity: Similarity, turns: Array) -> Array:
    """Degrees between the rotation of each camera from frame to frame and that of the similarity."""
    cosines = (np.einsum("vij,ij->v", turns, similarity.rotation.numpy()) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def _extents(centers: Array) -> list[float]:
    """Estimates of the size of the region that the cameras stand in, the likeliest first.

    Usually twice the median distance from the median centre, which wrong poses do not change, then twice the upper quartile.
    If half of the cameras stand on one tripod, the quartile comes first. If nearly all do, it is twice the largest distance.
    """
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    median, upper, largest = (2 * float(np.quantile(distances, q)) for q in (0.5, 0.75, 1.0))
    if upper <= TRIPOD * largest and median <= TRIPOD * largest:
        return [largest]
    return [upper, median] if median <= TRIPOD * upper else [median, upper]


def _center(camera: Camera) -> Array:
    return camera.center.cpu().numpy()


def _rotation(camera: Camera) -> Array:
    return camera.viewmat[:3, :3].detach().double().cpu().numpy()
