"""Points for a scene whose poses are known: features and matches by pycolmap, triangulated; no pose and no lens changes."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from .._files import real_path
from ..cameras.camera import Camera, exact_rotation
from .files import SceneError
from .scene import Scene, check_is_scene
from .sfm import SfmConfig, SfmRun, sfm_run

MOST_VIEWS = 200  # that `find_points` looks at, evenly chosen: about 100,000 points of a room in some minutes
NEIGHBOURS = 20  # views that each view is compared with: twice what COLMAP takes of a video
SAME_WAY = 0.3  # cosine of the angle between two viewing directions: beyond it, SIFT finds nothing in common
FEWEST = 10  # points to start a field from
AGREEING = 0.2
"""The share of the matches that must agree with the poses. Of 6 photographs with their poses 97 % agree, with poses at random
1 %, with inverted ones 4 %, with the axes of another convention none."""


def find_points(scene: Scene, *, config: SfmConfig | None = None, progress: bool = False) -> Scene:
    """Triangulate points from a scene's own poses. They replace the points that it has.

    Args:
        scene: posed views, with or without lens; at most `MOST_VIEWS` of them are looked at, evenly chosen.
        config: `max_features`, `seed` and `num_threads` are used.
        progress: show a bar.

    Raises:
        FileNotFoundError: if a picture is missing.
        SceneError: if there are fewer than 2 views, or pictures and poses do not fit together.
        ImportError: if pycolmap is not installed.
    """
    check_is_scene(scene)
    count = min(MOST_VIEWS, len(scene))
    if count < 2:
        raise SceneError(f"scene: expected at least 2 views to triangulate points, got {count}; add pictures")
    seen = scene.select(np.linspace(0, len(scene) - 1, count).round().astype(int).tolist())
    for path in (path for path in seen.image_paths if not path.is_file()):
        raise FileNotFoundError(f"{path}: no such file; expected a picture of the scene there")
    what = "scene: expected pictures that fit their poses"
    advice = "check the pictures, or estimate the poses again (`kfgs sfm --ignore-poses`)"
    with tempfile.TemporaryDirectory(prefix="kfgs-points-") as scratch:
        folder, photos = Path(scratch), {}
        for i, path in enumerate(seen.image_paths):
            name = f"{i:06d}{path.suffix.lower()}"  # pycolmap cuts names at blanks in a list of pairs
            (folder / name).symlink_to(real_path(path))
            photos[name] = (path, None if seen.masks is None else seen.masks[i])
        with sfm_run(folder, photos, config or SfmConfig(), what, advice, progress) as run:
            known = _triangulate(run, seen)
            known.extract_colors_for_all_images(scratch)
            points = [known.points3D[i] for i in sorted(known.points3D)]
    places = torch.from_numpy(np.array([point.xyz for point in points])).float()
    return replace(scene, points=places, colors=torch.from_numpy(np.array([p.color for p in points], np.uint8)))


def _triangulate(run: SfmRun, seen: Scene) -> Any:
    """The views as pycolmap has them, with points that enough matches agree on."""
    pycolmap, names = run.pycolmap, list(run.photos)
    known = _reconstruction(pycolmap, seen, names)
    with pycolmap.Database.open(run.database) as database:
        for kind in ("camera", "rig", "frame", "image"):
            for value in getattr(known, f"{kind}s").values():
                getattr(database, f"write_{kind}")(value, **{f"use_{kind}_id": True})
    run.extract(known=True)
    run.match([(names[a], names[b]) for a, b in neighbours(seen.cameras)])
    (run.scratch / "points").mkdir()
    pycolmap.triangulate_points(known, run.database, str(run.images), str(run.scratch / "points"), True, run.options())
    with pycolmap.Database.open(run.database) as database:
        matches = sum(len(pair.inlier_matches) for pair in database.read_two_view_geometries()[1])
    lengths = [len(point.track.elements) for point in known.points3D.values()]
    agree = sum(n * (n - 1) // 2 for n in lengths)
    if len(lengths) < FEWEST or agree < AGREEING * matches:
        got = f"{matches} matches of which {agree} agree with the poses ({len(lengths)} points)"
        ask = "do the poses belong to these pictures, and is their axis convention right"
        advice = f"{ask}? Else estimate them again (`kfgs sfm --ignore-poses`)"
        raise SceneError(f"scene: expected pictures that fit their poses, got {got}; {advice}")
    return known


def neighbours(cameras: list[Camera]) -> list[tuple[int, int]]:
    """Pairs of views to compare: each with the `NEIGHBOURS` nearest ones that look the same way, up to `SAME_WAY`."""
    centres = torch.stack([camera.center for camera in cameras]).double().numpy()
    axes = torch.stack([camera.viewmat[2, :3] for camera in cameras]).double().numpy()
    near = cKDTree(centres).query(centres, k=min(4 * NEIGHBOURS, len(cameras)))[1].reshape(len(cameras), -1)
    pairs = set()
    for a, others in enumerate(near.tolist()):
        fits = [b for b in others if b != a and float(axes[a] @ axes[b]) > SAME_WAY]
        pairs |= {(min(a, b), max(a, b)) for b in fits[:NEIGHBOURS]}
    return sorted(pairs)


def _reconstruction(pycolmap: Any, scene: Scene, names: list[str]) -> Any:
    """The views as pycolmap has them, each with its own camera."""
    known = pycolmap.Reconstruction()
    for i, (lens, name) in enumerate(zip(scene.lenses or scene.cameras, names, strict=True), 1):
        params = lens.model.params.tolist()  # kornia's models have COLMAP's order of parameters
        model = {4: "PINHOLE", 8: "OPENCV_FISHEYE", 12: "FULL_OPENCV"}[len(params)]
        camera = pycolmap.Camera(model=model, width=lens.width, height=lens.height, params=params, camera_id=i)
        camera.has_prior_focal_length = True
        known.add_camera_with_trivial_rig(camera)
        R = exact_rotation("viewmat", lens.viewmat[:3, :3]).numpy()  # float32 is not orthonormal enough
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), lens.viewmat[:3, 3].double().numpy())
        known.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=i, image_id=i), pose)
    return known
