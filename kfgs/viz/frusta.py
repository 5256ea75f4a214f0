"""Draw cameras in the scene: as pyramids of lines, and with their pictures on the image plane."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image
from torch import Tensor

from .._check import as_array, check_range, check_shapes
from ..cameras import Camera, as_cameras
from .colors import Array
from .linked import evenly
from .pictures import as_bytes
from .plotter import draw_mesh, origin_of

if TYPE_CHECKING:
    import pyvista as pv

PICTURE = 512  # pixels: the longest edge of a picture


def add_cameras(
    plotter: pv.Plotter,
    cameras: Any,
    *,
    images: Sequence[Tensor | Array] | Callable[[int], Tensor | Array] = (),  # each [H, W, 3] in [0, 1] or uint8
    size: float | None = None,
    color: str = "black",
    line_width: float = 1.5,
    most: int | None = None,
) -> pv.Actor:
    """Draw cameras as pyramids with their true opening; a small roof marks the upper edge of the picture.

    Args:
        plotter: where to draw.
        cameras: a list, or a scene or a field that has some; their distortion is ignored here.
        images: pictures for the image planes: one for each camera, or a function of the camera's index (`scene.image`), called
            only for the cameras drawn. Any size; the picture is stretched to its camera's. () draws none.
        size: depth of the pyramids, world units; None: a twentieth of the extent of the cameras' positions.
        color: a colour that pyvista knows.
        line_width: in pixels.
        most: draw at most this many, evenly chosen; None: all.

    Returns:
        The actor of the lines; its mesh's cells carry `camera`, the index.

    Raises:
        ValueError: if there are no cameras, the size is not positive, or there are not as many images as cameras.
    """
    import pyvista as pv

    cameras = as_cameras(cameras, "load a scene with views")
    if not callable(images) and len(images) not in (0, len(cameras)):
        raise ValueError(f"images: expected {len(cameras)} (one per camera), got {len(images)}; give one for each")
    centers = np.stack([as_array(camera.with_origin(cameras[0].origin).center) for camera in cameras])
    depth = size if size is not None else 0.05 * float(np.ptp(centers, axis=0).max()) or 0.2
    check_range("size", depth, 0, closed=(False, False))
    chosen = evenly(len(cameras), most)
    origin = origin_of(plotter, cameras[0].origin)
    edges = np.stack([_frustum(cameras[i].with_origin(origin), depth) for i in chosen])  # [C, 10, 2, 3]
    mesh = pv.line_segments_from_points(edges.reshape(-1, 3))
    mesh.cell_data["camera"] = np.repeat(chosen, 10)
    for i, corners in zip(chosen, edges[:, :4, 1] if callable(images) or images else (), strict=False):
        picture = images(int(i)) if callable(images) else images[i]
        check_shapes((f"images[{i}]", picture, "H W 3"))
        small = Image.fromarray(as_bytes(picture))
        small.thumbnail((PICTURE, PICTURE), Image.Resampling.BOX)
        plane = pv.PolyData.from_regular_faces(corners.astype(np.float32), np.arange(4)[None])
        plane.active_texture_coordinates = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32)  # rows from below
        draw_mesh(plotter, plane, texture=pv.numpy_to_texture(np.asarray(small)), lighting=False)
    return draw_mesh(plotter, mesh, color=color, line_width=line_width, lighting=False)


def _frustum(camera: Camera, depth: float) -> Array:  # [10, 2, 3]
    """Four edges from the centre, four around the picture, two for the roof."""
    K, R, o = (as_array(part).astype(np.float64) for part in (camera.K, camera.R, camera.center))
    pixels = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, -0.2]]) * camera.size[::-1]  # corners, the ridge
    rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))]) * depth
    a, b, c, d, ridge = rays @ R + o
    return np.array([(o, a), (o, b), (o, c), (o, d), (a, b), (b, c), (c, d), (d, a), (a, ridge), (ridge, b)])
