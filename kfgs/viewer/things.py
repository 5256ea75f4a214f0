"""Points, meshes, boxes and labels that are shown with a scene, in the form that the browser reads."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import torch

from .._check import ORIGIN, as_array, check_range, check_shapes
from .._origin import Origin, recounted
from .._rows import check_finite
from ..labels import OrientedBox, Part
from ..labels.color import parse_color
from ..viz.colors import Array
from ..viz.pictures import as_bytes

PLAIN = "#3d8bff"  # the colour of what has none
COLORED = ("rgb", "RGB", "RGBA", "colors")  # what arrays of colours are called in pyvista


def pack_thing(thing: Any, color: Any, origin: Origin) -> dict[str, Any]:
    """A thing as JSON: `marks`, the corners of boxes or the place of a label; or in base64 `places`, `colors` and `faces`.

    See `Viewer.add`; a ValueError or TypeError for what cannot be shown. Places are counted from the scene's origin.
    """
    boxes = thing if isinstance(thing, list | tuple) else [thing]
    if boxes and all(isinstance(box, Part | OrientedBox) for box in boxes):
        corners = [(box.box if isinstance(box, Part) else box).corners for box in boxes]
        return {"marks": [recounted(own.cpu(), ORIGIN, origin).tolist() for own in corners]}
    faces, own = np.zeros((0, 3)), None
    if hasattr(thing, "faces") and hasattr(thing, "point_data"):  # of pyvista; points alone have no faces
        own = next((own for name in COLORED if np.ndim(own := thing.point_data.get(name)) == 2), None)
        thing, faces = thing.points, thing.triangulate().faces.reshape(-1, 4)[:, 1:]
    elif hasattr(thing, "faces") and hasattr(thing, "vertices"):  # of trimesh, for instance
        own = getattr(getattr(thing, "visual", None), "vertex_colors", None)  # trimesh: opaque grey by default
        thing, faces = thing.vertices, as_array(thing.faces, "thing.faces")
    places = torch.from_numpy(as_array(thing, "thing").astype(np.float64))
    check_shapes(("thing", places, "3" if places.ndim == 1 else "N 3"), ("thing.faces", faces, "F 3"))
    check_finite("thing", places.float())  # as the browser has them
    if faces.size:
        for corner in (faces.min(), faces.max()):
            check_range("thing.faces", corner, 0, len(places) - 1)
    places = recounted(places, ORIGIN, origin)
    if places.ndim == 1:
        return {"marks": [[places.tolist()]]}
    if color is not None and np.ndim(color) == 2:
        own = as_array(color, "color")
    elif color is not None or own is None:
        own = np.tile(parse_color(PLAIN if color is None else color, "color"), (len(places), 1))
    check_shapes(("thing", places, "N 3"), ("color", own[:, :3], "N 3"))
    colors = (own.astype(np.uint8) if own.dtype.kind in "iu" else as_bytes(own))[:, :3]  # trimesh has four channels
    made = {"places": _text(places.numpy(), "<f4"), "colors": _text(colors, "u1")}
    return made | ({"faces": _text(faces, "<u4")} if faces.size else {})


def _text(values: Array, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()
