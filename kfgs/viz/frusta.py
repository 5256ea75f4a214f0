"""Draw cameras in the scene: as pyramids of lines, and with their pictures on the image plane."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from torch import Tensor

from .._check import as_array, check_range, check_shapes, check_whole
from ..cameras import Camera
from ..cameras.camera import at_one_origin
from .colors import Array
from .linked import evenly
from .pictures import as_bytes
from .plotter import draw_mesh, placed

if TYPE_CHECKING:
    import pyvista as pv

ATLAS = 4096  # edge of the texture in pixels; every OpenGL allows more
PICTURE = 512  # the longest edge of one picture in it, in pixels


def add_cameras(
    plotter: pv.Plotter,
    cameras: Sequence[Camera],
    *,
    size: float | None = None,
    color: str = "black",
    line_width: float = 1.5,
    most: int | None = None,
) -> pv.Actor:
    """Draw cameras as pyramids with their true opening; a small roof marks the upper edge of the picture.

    Args:
        plotter: where to draw.
        cameras: their distortion is ignored here.
        size: depth of the pyramids, world units; None: a twentieth of the extent of the cameras' positions.
        color: a colour that pyvista knows.
        line_width: in pixels.
        most: draw at most this many, evenly chosen; None: all.

    Returns:
        The actor; its mesh's cells carry `camera`, the index.

    Raises:
        ValueError: if there are no cameras, or the size or `most` is not positive.
    """
    depth, chosen = _chosen(cameras, size, most)
    import pyvista as pv

    segments = np.concatenate([_frustum(placed(plotter, cameras[i]), depth) for i in chosen])  # [10 C, 2, 3]
    mesh = pv.line_segments_from_points(segments.reshape(-1, 3))
    mesh.cell_data["camera"] = np.repeat(chosen, 10)
    return draw_mesh(plotter, mesh, color=color, line_width=line_width, lighting=False)


def add_camera_images(
    plotter: pv.Plotter,
    cameras: Sequence[Camera],
    images: Sequence[Tensor | Array] | Callable[[int], Tensor | Array],  # each [H, W, 3] in [0, 1] or uint8
    *,
    size: float | None = None,
    opacity: float = 1.0,
    most: int | None = None,
) -> pv.Actor:
    """Draw each camera's picture on its image plane, where `add_cameras` with the same arguments puts the pyramids.

    All pictures are reduced into one texture, so that a hundred pictures need one actor only.

    Args:
        plotter: where to draw.
        cameras: their distortion is ignored here.
        images: one for each camera, or a function of the camera's index, for instance `scene.image`, called only for the
            cameras drawn. Any size; the picture is stretched to its camera's.
        size: distance of the pictures from their cameras, world units; None: as in `add_cameras`.
        opacity: of the pictures, in (0, 1].
        most: draw at most this many, evenly chosen; None: all.

    Returns:
        The actor; its mesh's cells carry `camera`, the index.

    Raises:
        ValueError: if there are no cameras, not as many images, an image is not [H, W, 3], or a number is out of range.
    """
    depth, chosen = _chosen(cameras, size, most)
    check_range("opacity", opacity, 0, 1, closed=(False, True))
    if not callable(images) and len(images) != len(cameras):
        raise ValueError(f"images: expected {len(cameras)} (one per camera), got {len(images)}; give one for each")
    import pyvista as pv

    columns = int(np.ceil(np.sqrt(len(chosen))))
    cell = min(PICTURE, ATLAS // columns)
    atlas = np.full((cell * -(-len(chosen) // columns), cell * columns, 3), 255, np.uint8)
    corners, places = [], []
    for slot, i in enumerate(chosen):
        picture = images(int(i)) if callable(images) else images[i]
        check_shapes((f"images[{i}]", picture, "H W 3"))
        small = Image.fromarray(as_bytes(picture))
        small.thumbnail((cell, cell), Image.Resampling.BOX)
        top, left = cell * (slot // columns), cell * (slot % columns)
        atlas[top : top + small.height, left : left + small.width] = np.asarray(small)
        # half a pixel inside, so that the neighbour in the texture does not show at the border
        x, y = np.array([left + 0.5, left + small.width - 0.5]), np.array([top + 0.5, top + small.height - 0.5])
        x, y = x / atlas.shape[1], 1 - y / atlas.shape[0]  # OpenGL counts rows from below
        places += [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        corners += list(_frustum(placed(plotter, cameras[i]), depth)[:4, 1])
    faces = np.arange(4 * len(chosen)).reshape(-1, 4)
    mesh = pv.PolyData.from_regular_faces(np.array(corners, dtype=np.float32), faces)
    mesh.active_texture_coordinates = np.array(places, dtype=np.float32)
    mesh.cell_data["camera"] = chosen
    return draw_mesh(plotter, mesh, texture=pv.numpy_to_texture(atlas), lighting=False, opacity=opacity)


def _chosen(cameras: Sequence[Camera], size: float | None, most: int | None) -> tuple[float, Array]:
    """The depth of the pyramids, and which cameras are drawn."""
    if not cameras:
        raise ValueError("cameras: expected at least one camera, got none; load a scene with views")
    if most is not None:
        check_whole("most", most, 1)
    centers = np.stack([as_array(camera.center) for camera in at_one_origin(cameras)]).astype(np.float64)
    extent = float(np.ptp(centers, axis=0).max())
    depth = size if size is not None else (0.05 * extent if extent > 0 else 0.2)
    check_range("size", depth, 0, closed=(False, False))
    return depth, evenly(len(cameras), most)


def _frustum(camera: Camera, depth: float) -> Array:  # [10, 2, 3]
    """Four edges from the centre, four around the picture, two for the roof."""
    K, E = as_array(camera.K).astype(np.float64), as_array(camera.viewmat).astype(np.float64)
    w, h = camera.width, camera.height
    pixels = np.array([[0, 0], [w, 0], [w, h], [0, h], [w / 2, -h / 5]])  # the corners, then the ridge of the roof
    rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))]) * depth
    a, b, c, d, ridge = (rays - E[:3, 3]) @ E[:3, :3]  # R^T (x - t)
    o = -E[:3, 3] @ E[:3, :3]
    return np.array([(o, a), (o, b), (o, c), (o, d), (a, b), (b, c), (c, d), (d, a), (a, ridge), (ridge, b)])
