"""Two frames of one scene: the similarity between them, from cameras of the same names; and whether two clouds share one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from .._arrays import Array
from .._check import as_tensor, check_shapes
from .._files import file_stem, folded_name
from .._rows import check_finite
from ..cameras.camera import Camera
from ..cameras.paths import robust_bounds
from ..cameras.similarity import Similarity
from .files import SceneError, some

MAX_ERROR = 0.03  # of the cameras' extent: two SfM runs of one scene differ by well below a hundredth
MAX_ANGLE = 15.0  # degrees between a camera's two orientations, after alignment
MIN_INLIERS = 0.5  # share of the common cameras that must fit
TRIPOD = 0.01  # cameras closer together than this share of the extent stand at one place
ROUNDING = 1e-4  # of the extent: poses in float32 may be off by that, where the frame stands far from its origin
SIGMAS = 4.0  # in the last fits, cameras farther off than this many median distances are left out
PAIRS = 5_000  # pairs of cameras tried for scale and place

SAMPLE = 20_000  # points of each cloud that are measured
REACH_SPACINGS, REACH_SIZE, REACH_MOST = 2.0, 0.01, 0.025  # near: spacings, but between these shares of the size
NEAR_SHARE, LEAST_SHARE = 0.8, 0.3
"""Shares of the points of the better and of the worse cloud that must be near. (Field and colour splat of Replica's room_0: 0.88;
the toy room turned by half a turn: 0.63.) The second is low because one cloud may be a part of the other."""
DRIFT_SHARE, DRIFT_SIZE, BOTH_NEAR, DRIFT_MOST = 0.9, 0.005, 0.85, 0.0115
"""The best fit nearby may move 90 % of the surface, along its normals, by at most `DRIFT_SIZE` of the size, or `DRIFT_MOST` if
`BOTH_NEAR` of both clouds is near. (Field and colours of the toy room in one frame: 0.0056 to 0.0101 with 89 %
near; 5 % larger: 0.0126 and 0.0135, and with few points 0.0064 with 71 % near.)"""
NEARBY, FITTED, FEWEST = 0.05, 3_000, 12  # of the size: counterparts; points of the fit; fewer points give no surface


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity that brings a source frame onto a destination frame, and how well it fits."""

    similarity: Similarity  # x_dst = scale R x_src + t
    rms: float  # root mean square distance of the inliers, world units of the destination
    size: float  # extent of the compared cameras in the destination, world units
    inliers: int  # cameras that fit
    count: int  # cameras that were compared
    left_out: tuple[str, ...]  # names of the cameras that do not fit

    def __repr__(self) -> str:
        return f"Alignment({self.summary})"

    @property
    def summary(self) -> str:
        """One sentence: the scale, how many fit and how closely."""
        near = f"rms {self.rms:.3g} ({self.rms / self.size:.2%} of the extent {self.size:.3g})"
        fits = f"{self.inliers} of {self.count} fit"
        return f"cameras of the same names: scale {self.similarity.scale:.6g}, {fits}, {near}"

    def to_json(self) -> dict[str, Any]:
        """The similarity's matrix and every number, as plain lists and floats."""
        motion = {"matrix": self.similarity.matrix().tolist(), "scale": self.similarity.scale}
        fit = {"rms": self.rms, "rms of extent": self.rms / self.size, "inliers": self.inliers, "count": self.count}
        return {**motion, **fit, "left out": list(self.left_out)}


def align_by_cameras(src: Sequence[Camera], dst: Sequence[Camera]) -> Alignment:
    """The similarity between two reconstructions of the same pictures, from the cameras that have the same names.

    Wrong poses are left out as long as half of the common cameras agree. The rotation is the one that most orientations agree
    on; scale and translation come from the pair of centres that fits most cameras; least squares on the cameras that fit, in
    place and in orientation, refine all (Umeyama 1991, by scikit-image). Intrinsics are not used. Names are compared without
    folder and suffix ("images/a.JPG" is "a.png"), unless names repeat without folders.

    Raises:
        SceneError: if fewer than two names are common, all common cameras stand at one place (no scale follows), or
            fewer than half agree on one similarity.
    """
    pairs = _common_cameras(src, dst)
    names = [file_stem(a.name) for a, _ in pairs]
    origins = pairs[0][0].origin, pairs[0][1].origin
    sides = [[pair[k].to(torch.float64).with_origin(origins[k]) for pair in pairs] for k in (0, 1)]
    A, B = (torch.stack([camera.center for camera in side]).cpu().numpy() for side in sides)  # [V, 3]
    R, S = (torch.stack([camera.viewmat[:3, :3] for camera in side]).detach().cpu().numpy() for side in sides)
    turns = S.transpose(0, 2, 1) @ R  # [V, 3, 3] source world to destination world
    sizes, least = _extents(B), max(2, MIN_INLIERS * len(A))
    if min(sizes[0] / max(1.0, np.abs(B).max()), _extents(A)[0] / max(1.0, np.abs(A).max())) < 1e-9:
        got = f"{len(pairs)} at one ({some(names)}), from which no scale follows"
        advice = "give more views, or pass the similarity"
        raise SceneError(f"cameras: expected common cameras at different places, got {got}; {advice}")
    similarity, good, size = None, np.zeros(len(A), dtype=bool), sizes[0]
    for trial in sizes:
        start = _start(A, B, turns, MAX_ERROR * trial) if good.sum() < least else None
        if start is not None:
            fit, fits = _refine(start, A, B, turns, trial)
            spread = np.ptp(B[fits], axis=0).max(initial=0.0) if fits.any() else 0.0
            if spread > TRIPOD * trial and fits.sum() > good.sum():  # at one place any scale fits
                similarity, good, size = fit, fits, trial
    if similarity is None or good.sum() < least:
        expected = f"at least half of the {len(pairs)} common cameras to fit one similarity, got {int(good.sum())}"
        advice = "check that the names mean the same pictures in both, or pass the similarity"
        raise SceneError(f"cameras: expected {expected}; {advice}")
    lost = tuple(name for name, ok in zip(names, good, strict=True) if not ok)
    rms = float(np.sqrt((_errors(similarity, A, B, turns)[0][good] ** 2).mean()))
    return Alignment(similarity.between_worlds(*origins), rms, size, int(good.sum()), len(pairs), lost)


def _common_cameras(src: Sequence[Camera], dst: Sequence[Camera]) -> list[tuple[Camera, Camera]]:
    keys: tuple[Callable[[str], str], ...] = (lambda name: PurePosixPath(folded_name(name)).name, folded_name, str)
    for key in keys:  # the shortest form in which names do not repeat
        there, here = ({key(file_stem(camera.name)): camera for camera in side} for side in (dst, src))
        if len(there) == len(dst) and len(here) == len(src):
            break
    pairs = [(camera, there[name]) for name, camera in here.items() if name in there]
    if len(pairs) < 2:
        names = (some([camera.name for camera in side], 3) for side in (src, dst))
        got = f"{len(pairs)} (source, destination: {'; '.join(names)})"
        advice = "give both the names of their pictures, or pass the similarity"
        raise SceneError(f"cameras: expected at least two names that both have, got {got}; {advice}")
    return pairs


def _start(A: Array, B: Array, turns: Array, reach: float) -> Similarity | None:
    """The rotation that most cameras' orientations agree on, then scale and translation from the best pair of centres."""
    near = (np.einsum("iab,jab->ij", turns, turns) - 1) / 2 > np.cos(np.radians(MAX_ANGLE))
    row = near[int(near.sum(1).argmax())]
    R = Rotation.from_matrix(turns[row]).mean().as_matrix()
    turned, there = A[row] @ R.T, B[row]  # [n, 3]
    pairs = np.stack(np.triu_indices(len(turned), 1))
    i, j = pairs[:, np.random.default_rng(0).permutation(pairs.shape[1])[:PAIRS]]
    base, other = turned[j] - turned[i], there[j] - there[i]
    scales = (base * other).sum(1) / np.maximum((base**2).sum(1), 1e-300)
    best, most = None, 0
    for scale, first in zip(scales[scales > 0], i[scales > 0], strict=True):
        shift = there[first] - scale * turned[first]
        fits = int((np.linalg.norm(scale * turned + shift - there, axis=1) < reach).sum())
        if fits > most:
            best, most = Similarity(float(scale), torch.from_numpy(R), torch.from_numpy(shift)), fits
    return best


def _refine(similarity: Similarity, A: Array, B: Array, turns: Array, size: float) -> tuple[Similarity, Array]:
    """Least squares over the cameras that fit, repeated until they stay the same; gives the fit and these cameras."""
    limit, before = MAX_ERROR * size, np.zeros(len(A), dtype=bool)
    errors, angles = _errors(similarity, A, B, turns)
    for _ in range(10):
        good = (errors <= limit) & (angles <= MAX_ANGLE)
        if good.sum() < 2 or bool((good == before).all()):
            break
        a, b = A[good] - A[good].mean(0), B[good] - B[good].mean(0)
        widths = np.linalg.svd(a, compute_uv=False)
        if len(a) < 3 or widths[1] < 1e-3 * widths[0]:  # on a line: the rotation is that of the orientations
            R = Rotation.from_matrix(turns[good]).mean().as_matrix()
            scale = float(((a @ R.T) * b).sum() / (a**2).sum())
            shift = B[good].mean(0) - scale * R @ A[good].mean(0)
            similarity = Similarity(scale, torch.from_numpy(R), torch.from_numpy(shift))
        else:
            from skimage.transform import SimilarityTransform  # slow to import, and seldom needed

            similarity = Similarity.from_matrix(SimilarityTransform.from_estimate(A[good], B[good]).params)
        errors, angles = _errors(similarity, A, B, turns)
        limit, before = min(MAX_ERROR * size, SIGMAS * float(np.median(errors[good])) + ROUNDING * size), good
    return similarity, good


def _errors(similarity: Similarity, A: Array, B: Array, turns: Array) -> tuple[Array, Array]:
    """How far a similarity leaves each camera from its counterpart: the distance, and the angle in degrees."""
    distances = np.linalg.norm(similarity.apply(torch.from_numpy(A)).numpy() - B, axis=1)
    cosines = (np.einsum("vij,ij->v", turns, similarity.rotation.numpy()) - 1) / 2
    return distances, np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def _extents(centers: Array) -> list[float]:
    """Estimates of the size of the region that the cameras stand in, the likeliest first.

    Twice the median distance from the median centre, which wrong poses do not change, and twice the upper quartile; if half
    of the cameras stand on one tripod, the quartile first; if nearly all do, twice the largest distance.
    """
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    median, upper, largest = (2 * float(np.quantile(distances, q)) for q in (0.5, 0.75, 1.0))
    if upper <= TRIPOD * largest and median <= TRIPOD * largest:
        return [largest]
    return [upper, median] if median <= TRIPOD * upper else [median, upper]


class FrameCheck(NamedTuple):
    """Whether two clouds agree, and why."""

    agree: bool
    summary: str  # one sentence with the numbers
    near: tuple[float, float]  # share of src's points near dst, and of dst's near src
    drift: float  # how far the best fit nearby moves the surface of src, along its normals, world units


def frames_agree(src: Tensor, dst: Tensor) -> FrameCheck:  # [N, 3], [M, 3]
    """Decide whether two clouds of one scene are in the same frame.

    A point is near when it is closer to the other cloud than 2 of that cloud's spacings (median distance to the next
    point), at least 1 % and at most 2.5 % of the scene's size (diagonal of the `robust_bounds` of the smaller cloud).
    The clouds agree if 80 % of the points of one and 30 % of the other are near, and if they do not fit better a little
    elsewhere: least squares on point-to-plane distances moves 90 % of the points by less than 0.5 % of the size (1.15 %, if
    85 % of both are near).
    """
    src, dst = as_tensor("src", src), as_tensor("dst", dst)
    check_shapes(("src", src, "N 3"), ("dst", dst, "M 3"))
    a, b = _bulk("src", src), _bulk("dst", dst)
    size = min(float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in (a, b))
    trees: list[Any] = [cKDTree(a), cKDTree(b)]
    spacings = [float(np.median(tree.query(tree.data[:: max(1, tree.n // 5_000)], 2)[0][:, 1])) for tree in trees]
    to_src, to_dst = (min(max(REACH_SPACINGS * spacing, REACH_SIZE * size), REACH_MOST * size) for spacing in spacings)
    distances = trees[1].query(a)[0], trees[0].query(b)[0]
    near = float((distances[0] < to_dst).mean()), float((distances[1] < to_src).mean())
    drift = _drift(*(cloud[d < NEARBY * size] for cloud, d in zip((a, b), distances, strict=True)))
    most = DRIFT_MOST if min(near) >= BOTH_NEAR else DRIFT_SIZE
    agree = max(near) >= NEAR_SHARE and min(near) >= LEAST_SHARE and drift <= most * size
    summary = (
        f"the frames {'agree' if agree else 'disagree'}: {near[0]:.0%} and {near[1]:.0%} of the points lie within "
        f"{to_dst:.3g} and {to_src:.3g} of the other cloud (spacings {spacings[0]:.3g} and {spacings[1]:.3g}, size "
        f"{size:.3g}), and the best fit nearby moves their surface by {drift:.3g}"
    )
    return FrameCheck(agree, summary, near, drift)


def _bulk(name: str, points: Tensor) -> Array:
    """The points within robust bounds as float64, thinned to about `SAMPLE`, without duplicates (the spacing would be 0)."""
    values = points.detach().double().cpu()
    check_finite(name, values)
    if len(values) < 2:
        raise ValueError(f"{name}: expected at least two points, got {len(values)}; there is nothing to compare")
    kept: Array = values[robust_bounds(values, margin=0.0).inside].numpy() if len(values) > 100 else values.numpy()
    return np.unique(kept[:: max(1, len(kept) // SAMPLE)], axis=0)


def _drift(a: Array, b: Array) -> float:
    """How far the best fit nearby moves the surface of a; 0 if there are too few points to fit.

    Least squares on the distances to the other cloud's tangent planes, both ways, with Geman-McClure weights of a reach that
    shrinks. Only the motion along the normals counts, as walls slide along themselves unnoticed; edges have wrong normals.
    """
    if min(len(a), len(b)) < FEWEST:
        return 0.0
    (a, m, tree_a), (b, n, tree_b) = _with_normals(a), _with_normals(b)
    spacing = max(float(np.median(tree.query(tree.data, 2)[0][:, 1])) for tree in (tree_a, tree_b))
    R, s, t = np.eye(3), 1.0, np.zeros(3)
    for reach in REACH_SPACINGS * spacing * np.geomspace(2, 0.5, 10):
        moved = s * a @ R.T + t
        d, i = tree_b.query(moved)
        e, j = tree_a.query((b - t) @ R / s)
        P, Q = np.concatenate([moved, moved[j]]), np.concatenate([b[i], b])
        normals = np.concatenate([n[i], m[j] @ R.T])
        squares, counts = np.concatenate([d**2, (e * s) ** 2]), np.repeat([len(d), len(e)], [len(d), len(e)])
        w = ((reach**2 / (reach**2 + squares)) ** 2 / counts)[:, None]
        center = P.mean(0)
        arms = P - center
        rows = np.concatenate([np.cross(arms, normals), normals, (arms * normals).sum(1)[:, None]], axis=1)
        system = (rows * w).T @ rows  # [7, 7]: turn, shift, scale
        damping = 1e-4 * np.diag(np.maximum(np.diag(system), 1e-12 * np.trace(system)))
        x = np.linalg.solve(system + damping, (rows * w).T @ ((Q - P) * normals).sum(1))
        turn, factor = Rotation.from_rotvec(x[:3]).as_matrix(), float(np.exp(np.clip(x[6], -0.1, 0.1)))
        t = factor * turn @ (t - center) + center + x[3:6]
        R, s = Rotation.from_matrix(turn @ R).as_matrix(), s * factor
    return float(np.quantile(np.abs(((s * a @ R.T + t - a) * m).sum(1)), DRIFT_SHARE))


def _with_normals(points: Array) -> tuple[Array, Array, Any]:
    """At most `FITTED` points, evenly over the surface (means of the cells of a grid), their normals, and a tree of them."""
    cell, low = float(np.ptp(points, axis=0).max()), points.min(0)
    thinned = points
    while len(points) > FITTED:
        key = np.floor((points - low) / cell).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
        _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
        if len(counts) > 0.8 * FITTED:
            sums = [np.bincount(inverse, points[:, k]) for k in range(3)]
            chosen = np.random.default_rng(0).permutation(len(counts))[:FITTED]
            thinned = (np.stack(sums, axis=1) / counts[:, None])[chosen]
            break
        cell /= 1.1
    tree: Any = cKDTree(thinned)
    near = thinned[tree.query(thinned, min(12, len(thinned)))[1]]  # [n, k, 3]
    near = near - near.mean(1, keepdims=True)
    return thinned, np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0], tree
