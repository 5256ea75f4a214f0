"""Clouds as the point clouds of other libraries: trimesh and Open3D. They are imported only when asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from .._check import as_array
from .._typed import typed
from ..formats.splat_file import SplatFile
from ..gaussians import Gaussians
from .cloud_colors import Array, ColorBy
from .clouds import to_pyvista
from .field_colors import FeatureColors

if TYPE_CHECKING:
    import open3d
    import trimesh


@typed
def to_trimesh(
    cloud: Gaussians | SplatFile,
    color_by: ColorBy | Tensor | Array | None = None,
    *,
    feature_colors: FeatureColors | None = None,
) -> trimesh.PointCloud:
    """Convert a cloud to a `trimesh.PointCloud`: one point per Gaussian, in the colours that `to_pyvista` gives it.

    `metadata` has arrays with a row for each point: `opacity`, `scale` (standard deviations), `quat` (w, x, y, z), and, if
    present, `label` and `score`; and `classes`, the names of a splat's classes.

    Args:
        cloud: Gaussians or a splat; for a selection pass `gaussians[selection]`.
        color_by: the meaning of the colours, as in `add_cloud`.
        feature_colors: the scene's projection of features to colours.

    Raises:
        ImportError: if trimesh is not installed.
        ValueError: if the cloud lacks what to colour by.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(f"to_trimesh: expected trimesh ({error}); run: pip install trimesh") from error
    arrays, classes = _arrays(cloud, color_by, feature_colors)
    positions, rgb = arrays.pop("positions"), arrays.pop("rgb")
    return trimesh.PointCloud(positions, colors=rgb, metadata=arrays | {"classes": list(classes)})


@typed
def to_open3d(
    cloud: Gaussians | SplatFile,
    color_by: ColorBy | Tensor | Array | None = None,
    *,
    feature_colors: FeatureColors | None = None,
) -> open3d.t.geometry.PointCloud:
    """Convert a cloud to an `open3d.t.geometry.PointCloud`: one point per Gaussian, in the colours that `to_pyvista` gives it.

    Its attributes are `positions`, `colors` (uint8), `opacity`, `scale` (standard deviations), `quat` (w, x, y, z), and, if
    present, `label` (int32) and `score`, each with a row for each point. They are selected and written together with the points.
    `.to_legacy()` keeps positions and colours. Open3D has no place for the names of classes.

    Args:
        cloud: Gaussians or a splat; for a selection pass `gaussians[selection]`.
        color_by: the meaning of the colours, as in `add_cloud`.
        feature_colors: the scene's projection of features to colours.

    Raises:
        ImportError: if Open3D is not installed.
        ValueError: if the cloud lacks what to colour by.
    """
    try:
        import open3d
    except ImportError as error:
        raise ImportError(f"to_open3d: expected Open3D ({error}); run: pip install open3d") from error
    arrays, _ = _arrays(cloud, color_by, feature_colors)
    points = open3d.t.geometry.PointCloud(open3d.core.Tensor(arrays.pop("positions")))
    points.point["colors"] = open3d.core.Tensor(arrays.pop("rgb"))
    for name, values in arrays.items():
        if values.dtype == np.int64:  # which Open3D cannot write to a PLY
            values = values.astype(np.int32)
        points.point[name] = open3d.core.Tensor(values.reshape(len(values), -1))
    return points


def _arrays(
    cloud: Gaussians | SplatFile, color_by: ColorBy | Tensor | Array | None, feature_colors: FeatureColors | None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The arrays of `to_pyvista` and `positions`, each [N] or [N, k], and the names of the classes."""
    splats = SplatFile(cloud) if isinstance(cloud, Gaussians) else cloud
    points = to_pyvista(
        splats.gaussians if isinstance(splats, SplatFile) else splats, color_by, feature_colors=feature_colors
    )
    arrays = {name: np.array(points[name]) for name in points.point_data.keys() if name != "index"}  # noqa: SIM118
    if "score" in splats.extra:
        arrays.setdefault("score", as_array(splats.extra["score"]).astype(np.float32))
    return {"positions": np.array(points.points)} | arrays, splats.classes
