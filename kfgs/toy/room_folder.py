"""Write the toy room as a scene folder, with exact ground truth and the features of a noisy teacher."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from .._check import check_size, check_whole
from .._files import as_path, atomic_folder, check_output, read_json, write_json
from ..cameras.camera import Camera
from ..cameras.projection import camera_to_pixel, world_to_camera
from ..scenes.colmap import import_pycolmap
from .geometry import Array, Places, Solid, places_on, sample_surface, visible
from .light import light_reaches
from .patterns import Noise
from .render import render, surface_color, walk_cameras
from .room import CLASSES, build_room
from .teacher import class_embeddings, teacher_features

VERSION = 5  # of the generator: a folder written by another version is not reused
POINT_NOISE = 0.01  # metres, standard deviation of the sparse points around the surface
PIXEL_NOISE = 0.4  # pixels, standard deviation of their observations


@dataclass(frozen=True)
class ToyConfig:
    """Options of the toy room. Equal options give bit-identical folders on one machine."""

    seed: int = 0
    """Decides textures, hues, the places of the chairs, embeddings, and every error of the teacher."""
    train_views: int = 48
    """Training cameras, evenly spaced on two rounds through the room."""
    test_views: int = 12
    """Test cameras, each in the middle between two training cameras; at most `train_views`."""
    size: tuple[int, int] = (192, 256)
    """(height, width) of the images, pixels."""
    feature_size: tuple[int, int] = (72, 96)
    """(height, width) of the feature maps."""
    feature_dim: int = 512
    """D, channels of features and embeddings."""
    surface_points: int = 60_000
    """Ground-truth points, uniform by area over the surface that the training cameras see."""
    sparse_points: int = 20_000
    """Points of the COLMAP model, outliers included."""

    def __post_init__(self) -> None:
        for name, low in (("seed", 0), ("train_views", 2), ("feature_dim", 16), ("surface_points", 100)):
            check_whole(name, getattr(self, name), low)
        check_whole("test_views", self.test_views, 1, self.train_views)
        check_whole("sparse_points", self.sparse_points, 10, self.surface_points)
        for name in ("size", "feature_size"):
            check_size(tuple(getattr(self, name)), name, 8)
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if any(f > s for f, s in zip(self.feature_size, self.size, strict=True)):
            raise ValueError(
                f"feature_size: expected at most {self.size} (size), got {self.feature_size}; enlarge size"
            )


def make_toy_room(
    path: str | Path, config: ToyConfig | None = None, *, embeddings_of: int | None = None, progress: bool = False
) -> Path:
    """Render a furnished room of 6 x 5 x 2.9 metres and write it as a scene folder.

    **Convention**: metres, z up, floor at z = 0; cameras, pixels and the sparse model follow COLMAP; label images hold
    the index into `classes.json` (255, void, never occurs here). The principal point is off the centre and fx != fy.

    Files: `images/<stem>.png`, `labels/<stem>.png` (uint8), `depth/<stem>.npy` (float32 z-depth, metres),
    `features/<stem>_fmap_CxHxW.pt` (float16 [D, h, w], every view), `sparse/0` (COLMAP binary, all views),
    `classes.json`, `text.npy` (float32 [C, D], unit rows), `split.json` (stems of `train` and `test`), `surface.npz`
    (`points` [P, 3] and `normals` [P, 3] float32, `labels` [P] uint8, `seen` [P] = number of training views) and
    `toy.json` (configuration and version).

    Args:
        path: the folder to make. It appears complete or not at all. If it holds a toy room with the same options,
            nothing is written.
        config: options; the default takes about half a minute on two CPU cores and 120 MB of disk.
        embeddings_of: the seed of the classes' embeddings, which several rooms of a town share; None: the room's own.
        progress: show a bar over the views.

    Returns:
        `path`.

    Raises:
        FileExistsError: if `path` holds anything else.
    """
    from skimage.io import imsave

    path, config = as_path(path), config or ToyConfig()
    about = {"version": VERSION, "config": json.loads(json.dumps(asdict(config)))}
    if embeddings_of is not None:
        about["embeddings_of"] = embeddings_of
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        known = read_json(path / "toy.json") if (path / "toy.json").is_file() else None
        if known != about:
            raise FileExistsError(
                f"{path}: expected no folder, an empty one or a toy room made with {about}, got one with "
                f"{known or 'other files'}; choose another path or delete it"
            )
        return path
    check_output("path", path, "a folder")
    solids = build_room(config.seed)
    noise = Noise(np.random.default_rng([config.seed, 3]))
    cameras, testing = walk_cameras(config.train_views, config.test_views, config.size)
    with atomic_folder(path) as folder:
        for name in ("images", "labels", "depth", "features"):
            (folder / name).mkdir()
        embeddings = class_embeddings(config.feature_dim, config.seed if embeddings_of is None else embeddings_of)
        stems = [Path(camera.name).stem for camera in cameras]
        for stem, camera in zip(stems, tqdm(cameras, desc="toy room", disable=not progress), strict=True):
            image, depth, labels = render(solids, noise, camera)
            imsave(folder / "images" / f"{stem}.png", image, check_contrast=False)
            imsave(folder / "labels" / f"{stem}.png", labels, check_contrast=False)
            np.save(folder / "depth" / f"{stem}.npy", depth.astype(np.float32))
            rng = np.random.default_rng([config.seed, 4, zlib.crc32(stem.encode())])  # errors follow from seed and name
            features = teacher_features(labels, image, embeddings, config.feature_size, rng)
            torch.save(torch.from_numpy(features), folder / "features" / f"{stem}_fmap_CxHxW.pt")
        train, test = ([stems[i] for i in np.flatnonzero(testing == held)] for held in (False, True))
        write_json(folder / "split.json", {"train": train, "test": test})
        write_json(folder / "classes.json", list(CLASSES))
        np.save(folder / "text.npy", embeddings)
        _write_geometry(folder, solids, noise, cameras, testing, config)
        write_json(folder / "toy.json", about)
    return path


def _visible_surface(
    solids: Sequence[Solid], cameras: Sequence[Camera], count: int, rng: np.random.Generator
) -> tuple[Places, NDArray[np.bool_]]:
    """Draw `count` places uniformly by area where a camera sees them, and say which cameras see each, [P, C]."""
    areas = np.array([solid.area() for solid in solids])
    drawn: list[list[NDArray[Any]]] = []
    have, batch = 0, count
    while have < count:
        shares = rng.multinomial(batch, areas / areas.sum())
        points = np.concatenate([sample_surface(s, int(n), rng) for s, n in zip(solids, shares, strict=True)])
        places = places_on(solids, points, np.repeat(np.arange(len(solids)), shares))
        seen = np.stack([visible(solids, camera, places) for camera in cameras], axis=-1)
        rows = rng.permutation(np.flatnonzero(seen.any(-1)))
        drawn.append([values[rows] for values in (*places, seen)])
        have += len(rows)
        batch = max(int(1.1 * (count - have) * batch / max(len(rows), 1)), count // 20)
    points, outward, which, seen = (np.concatenate(parts)[:count] for parts in zip(*drawn, strict=True))
    return Places(points, outward, which), seen


def _write_geometry(
    folder: Path, solids: list[Solid], noise: Noise, cameras: list[Camera], tests: NDArray[np.bool_], config: ToyConfig
) -> None:
    """Write `surface.npz` and the sparse model: some of these points with noise, observations, and a few far outliers."""
    rng = np.random.default_rng([config.seed, 6])
    training = [camera for camera, test in zip(cameras, tests, strict=True) if not test]
    surface, seen = _visible_surface(solids, training, config.surface_points, rng)
    classes = np.array([CLASSES.index(solid.label) for solid in solids], np.uint8)
    views, (points, outward) = seen.sum(-1).astype(np.uint16), (part.astype(np.float32) for part in surface[:2])
    np.savez(folder / "surface.npz", points=points, normals=outward, labels=classes[surface.which], seen=views)
    chance = np.minimum(views, 8.0) + 1e-3  # SfM finds what many views share
    rows = rng.choice(len(seen), config.sparse_points, replace=False, p=chance / chance.sum())
    places = surface.take(rows)
    color = surface_color(solids, noise, places, np.full(len(rows), 0.01), light_reaches(solids, places))
    observed = np.stack([visible(solids, camera, places) for camera in cameras], axis=-1)
    placed = places.points + POINT_NOISE * rng.standard_normal(places.points.shape)
    outliers = max(1, len(rows) // 200)
    placed[:outliers] *= rng.uniform(3.0, 20.0, (outliers, 1))  # mismatches triangulate far behind the walls
    errors = PIXEL_NOISE * rng.standard_normal((*observed.shape, 2))
    _write_model(folder / "sparse" / "0", cameras, placed, np.round(color * 255).astype(np.uint8), observed, errors)


def _write_model(
    folder: Path,
    cameras: Sequence[Camera],  # one shared K
    points: Array,  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    seen: NDArray[np.bool_],  # [P, C] which camera observes which point
    errors: Array,  # [P, C, 2] added to the observed pixels
) -> None:
    """Write `cameras.bin`, `images.bin` and `points3D.bin` (one shared PINHOLE camera) into `folder` through pycolmap."""
    pycolmap = import_pycolmap()
    model, (height, width) = pycolmap.Reconstruction(), cameras[0].size
    params = cameras[0].K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()  # fx, fy, cx, cy
    lens = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    tracks, residuals = [pycolmap.Track() for _ in points], np.linalg.norm(errors, axis=-1)
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(seen[:, number])
        local = world_to_camera(camera, torch.from_numpy(points[rows]))
        xy = camera_to_pixel(camera, local).numpy() + errors[rows, number]
        image = pycolmap.Image(name=camera.name, camera_id=1, image_id=number + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(at) for at in xy])
        for place, row in enumerate(rows):
            tracks[row].add_element(number + 1, place)
        E = camera.viewmat.numpy()
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(E[:3, :3]), E[:3, 3]))
    for i, track in enumerate(tracks):
        point_id = model.add_point3D(points[i], track, colors[i])
        model.points3D[point_id].error = float(residuals[i][seen[i]].mean())
    folder.mkdir(parents=True)
    model.write(folder)
