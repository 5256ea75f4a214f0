"""Write a COLMAP model of known cameras and points, with tracks, as SfM would."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..scenes.pycolmap_import import import_pycolmap
from .geometry import Array, project


def write_model(
    folder: Path,
    cameras: Sequence[Camera],  # one shared K
    points: Array,  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    seen: NDArray[np.bool_],  # [P, C] which camera observes which point
    pixel_noise: Array,  # [P, C, 2] added to the observed pixels
) -> None:
    """Write `cameras.bin`, `images.bin` and `points3D.bin` (one shared PINHOLE camera) into `folder` through pycolmap."""
    pycolmap = import_pycolmap()
    first = cameras[0]
    K = first.K.double().numpy()
    model = pycolmap.Reconstruction()
    params = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=first.width, height=first.height, params=params, camera_id=1)
    )
    tracks = [pycolmap.Track() for _ in points]
    residuals = np.linalg.norm(pixel_noise, axis=-1)
    for number, camera in enumerate(cameras):
        E = camera.viewmat.double().numpy()
        image = pycolmap.Image(name=camera.name, camera_id=1, image_id=number + 1)
        rows = np.flatnonzero(seen[:, number])
        xy = project(camera, points[rows])[0] + pixel_noise[rows, number]
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(at) for at in xy])
        for place, row in enumerate(rows):
            tracks[row].add_element(number + 1, place)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(E[:3, :3]), E[:3, 3]))
    for i, track in enumerate(tracks):
        point_id = model.add_point3D(points[i], track, colors[i])
        model.points3D[point_id].error = float(residuals[i][seen[i]].mean())
    folder.mkdir(parents=True)
    model.write(folder)
