"""Keep floaters out of the first view: they would shrink the scene to a dot."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
OUTER = 0.01  # of the points beyond each side of the box
MARGIN = 0.05  # of the box's size, added on each side


def middle_box(points: Array) -> Array:  # [N, 3] -> [6]: x from, x to, y from, ...
    """The box around the middle 98 % of the points in each axis, with a margin; never larger than the box around all."""
    rows = np.sort(points.astype(np.float64), axis=0)
    cut = int(OUTER * len(rows))
    low, high = rows[cut], rows[len(rows) - 1 - cut]
    margin = MARGIN * (high - low)
    return np.stack([np.maximum(low - margin, rows[0]), np.minimum(high + margin, rows[-1])], axis=1).reshape(-1)


def frame_middle(renderer: Any) -> None:
    """When a view is reset to show everything, show the middle boxes of clouds (field data `box`) instead of their bounds.

    VTK calls the observer only then, not when a caller gives a box. Clipping planes keep everything.
    """

    def reset(*_: Any) -> None:
        shown = [actor for actor in renderer.actors.values() if actor.GetVisibility() and actor.GetUseBounds()]
        boxes = [box for box in map(_box, shown) if box is not None]
        if boxes:
            sides = np.array(boxes).reshape(-1, 3, 2)
            renderer.ResetCamera(*np.stack([sides[..., 0].min(axis=0), sides[..., 1].max(axis=0)], axis=1).reshape(-1))
            renderer.ResetCameraClippingRange()

    renderer.AddObserver("ResetCameraEvent", reset)


def _box(actor: Any) -> Array | None:
    """The box of a cloud, the bounds of another actor, None for one that has no place in the world."""
    mesh = getattr(getattr(actor, "mapper", None), "dataset", None)
    if mesh is not None and "box" in mesh.field_data and actor.GetMatrix().IsIdentity():
        return np.asarray(mesh.field_data["box"])
    bounds = actor.GetBounds()
    return None if bounds is None or bounds[0] > bounds[1] else np.asarray(bounds)
