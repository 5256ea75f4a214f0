"""Where the cameras of a rendered room stand: paths through free space, and unseen views of what they saw.

Everything asks one function for the distance to the nearest surface along rays, so a plan needs no renderer. **Convention**:
metres, z up; a pose is camera to world, x right, y down, z forward; the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Distances = Callable[[Array, Array], Array]
"""Origins [R, 3] and unit directions [R, 3] to distances [R]; inf where a ray hits nothing."""

CLEARANCE = 0.3  # metres to the nearest surface: no camera in a wall, or with its lens in a plant
STEP = 0.2  # metres between places of the grid: less than CLEARANCE, so the way from place to place is free
HEIGHTS = 1.0, 1.75  # metres above the floor, of an eye
OUTDOORS = 0.45  # share of directions that hit nothing: more of them, and the place is outside
NEAR, NEAR_SHARE, MEDIAN = 0.5, 0.1, 1.2  # a sight is blocked: this share nearer than NEAR, or half of it than MEDIAN
APART = 0.25  # metres between a test camera and every training camera
KNOWN, KNOWN_VIEWS = 0.9, 2  # share of a test view that as many training views saw


@dataclass(frozen=True)
class Lens:
    """A pinhole camera with its principal point in the centre."""

    width: int
    height: int
    focal: float  # pixels

    def rays(self, pose: Array, step: int = 1) -> tuple[Array, Array, Array]:
        """Origins [R, 3], unit directions [R, 3] and their lengths per unit of z-depth [R], of every `step`-th pixel."""
        v, u = np.mgrid[step // 2 : self.height : step, step // 2 : self.width : step].reshape(2, -1) + 0.5
        local = np.stack([u - self.width / 2, v - self.height / 2, np.full(len(u), self.focal)], -1) / self.focal
        lengths = np.linalg.norm(local, axis=-1)
        return np.tile(pose[:3, 3], (len(u), 1)), local / lengths[:, None] @ pose[:3, :3].T, lengths

    def pixels(self, pose: Array, points: Array) -> tuple[Array, Array]:
        """Pixels [P, 2] (x, y) and z-depths [P] of points; what is behind the camera or outside has pixel NaN."""
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = local[:, :2] / local[:, 2:] * self.focal + (self.width / 2, self.height / 2)
        inside = (local[:, 2] > 1e-6) & (xy >= 0).all(-1) & (xy < (self.width, self.height)).all(-1)
        return np.where(inside[:, None], xy, np.nan), local[:, 2]


def look(eye: Array, direction: Array) -> Array:  # [4, 4]
    """The pose of a camera at `eye` that looks along a direction which is not vertical."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], -1)
    return pose


def is_free(distances: Distances, places: Array, rays: int = 300) -> NDArray[np.bool_]:  # [P]
    """Whether places are in the room and farther than `CLEARANCE` from every surface, along rays of a Fibonacci lattice."""
    z, turn = 1 - (2 * np.arange(rays) + 1) / rays, np.arange(rays) * np.pi * (3 - 5**0.5)
    directions = np.stack([*(np.sqrt(1 - z**2) * [np.cos(turn), np.sin(turn)]), z], -1)
    hits = distances(np.repeat(places, rays, 0), np.tile(directions, (len(places), 1))).reshape(-1, rays)
    return (hits.min(-1) > CLEARANCE) & (np.isinf(hits).mean(-1) < OUTDOORS)


def free_places(distances: Distances, inside: Array) -> Array:  # [N, 3]
    """Free places at the height of an eye that can be reached from `inside`, on a grid of `STEP` metres."""
    floor = inside[2] - distances(inside[None], np.array([[0.0, 0.0, -1.0]]))[0]
    start = np.array([*inside[:2], np.clip(inside[2], floor + HEIGHTS[0], floor + HEIGHTS[1])])
    moves = np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
    known, free, border = {(0, 0, 0)}, [], np.zeros((1, 3), int)
    while len(border):
        places = start + STEP * border
        border = border[is_free(distances, places)]
        free.append(start + STEP * border)
        near = {tuple(cell) for cell in (border[:, None] + moves).reshape(-1, 3).tolist()} - known
        near = {cell for cell in near if HEIGHTS[0] <= start[2] + STEP * cell[2] - floor <= HEIGHTS[1]}
        known |= near
        border = np.array(sorted(near), dtype=int).reshape(-1, 3)
    if not len(free[0]):
        raise ValueError(f"inside: expected a place with {CLEARANCE} m around it in the room, got {inside.tolist()}")
    return np.concatenate(free)


def sees(distances: Distances, lens: Lens, pose: Array) -> bool:
    """Whether nothing blocks the sight of a camera."""
    hits = distances(*lens.rays(pose, max(lens.width // 16, 1))[:2])
    return bool((hits < NEAR).mean() <= NEAR_SHARE and np.median(hits) >= MEDIAN and np.isinf(hits).mean() < OUTDOORS)


def training_path(
    distances: Distances, lens: Lens, free: Array, middle: Array, count: int, rng: np.random.Generator
) -> list[Array]:
    """Two closed rounds through the free places, looking past `middle`: along the walls, then inside with wider swings.

    Where the sight is blocked, a camera turns until it is not. Returns `count` poses.
    """
    centre, phase = free.mean(0), rng.uniform(0, 2 * np.pi, 3)
    offset = free[:, :2] - centre[:2]
    radii, turns = np.linalg.norm(offset, axis=-1), np.arctan2(offset[:, 1], offset[:, 0])
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    wedge = np.abs((turns - angles[:, None] + np.pi) % (2 * np.pi) - np.pi) < np.pi / 12
    outer = np.where(wedge, radii, 0).max(-1)
    smooth = np.fft.irfft(np.fft.rfft(outer) * (np.arange(91) < 6), 180)  # five waves a round: a walk, not a scan
    poses = []
    for share, many, height, swing in ((0.95, count - count // 3, 1.5, 40), (0.55, count // 3, 1.3, 80)):
        heights = free[:, 2].min() - HEIGHTS[0] + height + 0.15 * np.sin(2 * angles + phase[0])
        ring = np.stack([*(centre[:2, None] + share * smooth * [np.cos(angles), np.sin(angles)]), heights], -1)
        for _ in range(20):
            if not len(tight := np.flatnonzero(~is_free(distances, ring))):
                break
            ring[tight, :2] += 0.1 * (centre[:2] - ring[tight, :2])
        lengths = np.linalg.norm(np.diff(ring, axis=0, append=ring[:1]), axis=-1).cumsum()
        for i in np.searchsorted(lengths, (np.arange(many) + 0.5) / many * lengths[-1]):
            way = middle - ring[i]
            yaw = np.arctan2(way[1], way[0]) + np.radians(swing) * np.sin(3 * angles[i] + phase[1])
            slope = way[2] / max(np.linalg.norm(way[:2]), 1.0) + 0.25 * np.sin(5 * angles[i] + phase[2])
            yaws = yaw + np.radians([0, 20, -20, 40, -40, 70, -70, 100, -100, 140, -140, 180])
            tries = (look(ring[i], np.array([np.cos(a), np.sin(a), slope])) for a in yaws)
            poses += islice((pose for pose in tries if sees(distances, lens, pose)), 1)
    if len(poses) < count or not is_free(distances, np.stack([pose[:3, 3] for pose in poses])).all():
        raise ValueError(f"train: expected {count} free places with free sight on two rounds, got {len(poses)}")
    return poses


def views_of(distances: Distances, lens: Lens, poses: list[Array], points: Array) -> NDArray[np.int64]:  # [P]
    """How many cameras see each point: inside the picture, and nothing before it."""
    eyes = np.stack([pose[:3, 3] for pose in poses])
    inside = np.stack([np.isfinite(lens.pixels(pose, points)[0][:, 0]) for pose in poses])
    views, rows = np.nonzero(inside)
    way = points[rows] - eyes[views]
    length = np.linalg.norm(way, axis=-1)
    inside[views, rows] = distances(eyes[views], way / length[:, None]) > 0.98 * length - 0.01
    return inside.sum(0)


def test_views(
    distances: Distances, lens: Lens, free: Array, train: list[Array], count: int, rng: np.random.Generator
) -> list[Array]:
    """Cameras at random free places that are not on the training path, looking at what training cameras saw."""
    eyes, views = np.stack([pose[:3, 3] for pose in train]), list[Array]()
    for _ in range(60 * count):
        eye = free[rng.integers(len(free))] + rng.uniform(-STEP / 2, STEP / 2, 3)
        near = np.linalg.norm(np.concatenate([eyes, *(view[None, :3, 3] for view in views)]) - eye, axis=-1)
        if near.min() <= APART or not is_free(distances, eye[None])[0]:
            continue
        origins, directions, _ = lens.rays(train[rng.integers(len(train))], max(lens.width // 8, 1))
        hits = origins + directions * distances(origins, directions)[:, None]
        way = hits[rng.integers(len(hits))] - eye
        flat = np.linalg.norm(way[:2])
        if not np.isfinite(way).all() or abs(way[2]) > flat:
            continue
        pose = look(eye, way)
        origins, directions, _ = lens.rays(pose, max(lens.width // 16, 1))
        hits = distances(origins, directions)
        points = (origins + directions * hits[:, None])[np.isfinite(hits)]
        if sees(distances, lens, pose) and (views_of(distances, lens, train, points) >= KNOWN_VIEWS).mean() >= KNOWN:
            views.append(pose)
        if len(views) == count:
            return views
    raise ValueError(f"test: expected {count} views of what training views saw, got {len(views)}; train more views")


def plan_views(
    distances: Distances, lens: Lens, inside: Array, middle: Array, train: int, test: int, seed: int
) -> dict[str, Array]:
    """The poses of all views by name, train_000 to test_029; `inside` is a free place, `middle` that of the things."""
    rng, free = np.random.default_rng(seed), free_places(distances, inside)
    poses = {"train": training_path(distances, lens, free, middle, train, rng)}
    poses["test"] = test_views(distances, lens, free, poses["train"], test, rng)
    return {f"{split}_{i:03d}": pose for split, views in poses.items() for i, pose in enumerate(views)}
