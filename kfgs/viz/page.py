"""Write a 3-D scene as one HTML file that works in any browser, offline.

vtk.js draws it. It has no Gaussians and would silently leave them out, so they become points or ellipsoids, and the page
says so. Only trame-vtk is used (its serialisers and its viewer). `plotter.trame.export_html` of trame-pyvista writes the
same file, but starts a server, which tries to download a viewer that it does not need.
"""

from __future__ import annotations

import html
import importlib
import io
import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from torch import Tensor

from .._check import as_array, check_choice, check_whole
from .._files import atomic_path
from .palette import palette
from .pictures import check_names
from .points_and_ellipsoids import MOST_EXPORTED, Instead, without_gaussians

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
STYLE = (
    "position:fixed;left:12px;bottom:12px;max-width:45vw;padding:8px 10px;background:rgba(255,255,255,.85);"
    "color:#222;font:13px/1.5 sans-serif;pointer-events:none"
)
SWATCH = "display:inline-block;width:.8em;height:.8em;margin-right:.5em;border:1px solid #222;background:rgb"


class Page(NamedTuple):
    """What was written."""

    path: Path
    drawn: int
    """Gaussians drawn as points or ellipsoids."""
    left_out: int
    """Gaussians that are not in the page: too faint, or too many."""
    note: str
    """The remark in the page about this; empty if the scene has no Gaussians."""


def save_page(
    path: str | Path,
    plotter: pv.Plotter,
    *,
    instead: Instead = "points",
    limit: int | None = None,
    labels: Tensor | Array | None = None,  # any shape, int
    names: Sequence[str] | None = None,
    title: str = "kfgs",
) -> Page:
    """Write a plotter's scene as a standalone page. Gaussians become points or ellipsoids.

    The page opens at the plotter's view. It contains the viewer (1 MB) and loads nothing. Legends and other flat actors
    are not exported: pass `labels` and `names` for a legend.

    Args:
        path: a name that ends in .html.
        plotter: with at least one actor; it does not change.
        instead: what replaces Gaussians: `points` at their means, or `ellipsoids`, the surfaces where alpha is 1/2.
        limit: the most Gaussians of each cloud, the strongest (opacity times area); None: 400,000 points or 10,000
            ellipsoids. Opacities up to 0.1 (points) or 1/2 (ellipsoids) are always left out.
        labels: the labels in the scene, for the legend.
        names: class names by index, for the legend.
        title: title of the page.

    Raises:
        ValueError: if the name does not end in .html, there is nothing to show, or a label has no name.
        ImportError: if trame-vtk is not installed.
    """
    target = Path(path)
    if target.suffix.lower() != ".html":
        raise ValueError(f"path: expected a name that ends in .html, got {target.name!r}; rename it")
    check_choice("instead", instead, MOST_EXPORTED)
    most = MOST_EXPORTED[instead] if limit is None else limit
    check_whole("limit", most, 1)
    legend = _legend(labels, names)
    if not any(renderer.actors for renderer in plotter.renderers):
        raise ValueError("plotter: expected at least one actor, got an empty scene; add a cloud first")
    serializers, viewer = _trame("trame_vtk.modules.vtk.serializers"), _trame("trame_vtk.tools.vtksz2html")
    for renderer in plotter.renderers:
        if not renderer.camera_set:  # nothing was drawn yet
            renderer.camera_position = renderer.get_default_cam_pos()
            renderer.reset_camera()
        renderer.UpdateLightsGeometryToFollowCamera()
    with without_gaussians(plotter, instead, most) as counts:
        scene = _scene(plotter, serializers)
    drawn, left_out = counts
    note = ""
    if drawn + left_out:
        note = f"{drawn:,} Gaussians are shown as {instead}, since this viewer has no Gaussians"
        note += f"; {left_out:,} faint or small ones are left out." if left_out else "."
    text = io.StringIO()
    viewer.write_html(scene, text)
    with atomic_path(target) as temporary:
        temporary.write_text(_furnish(text.getvalue(), title, note, legend), encoding="utf-8")
    return Page(target, drawn, left_out, note)


def _trame(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            "a page needs trame-vtk, which serialises VTK's scenes for browsers; run: pip install trame-vtk"
        ) from error


def _scene(plotter: pv.Plotter, serializers: Any) -> bytes:
    """The render window in vtk.js's format: a zip with one JSON, and arrays in base64 by their hashes."""
    serializers.initialize_serializers()
    context = serializers.SynchronizationContext()
    context.set_ignore_last_dependencies(True)
    window = plotter.render_window
    state = serializers.serialize(None, window, serializers.reference_id(window), context, 1)
    for renderer in plotter.renderers:
        _turn_about_middle(state, serializers.reference_id(renderer.GetActiveCamera()), renderer)
    arrays = {
        entry["hash"]: {**entry, "content": context.get_cached_data_array(entry["hash"], False)}
        for entry in serializers.extract_array_hash(state)
    }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("index.json", json.dumps({"hashes": arrays, "scene": state}))
    return packed.getvalue()


def _turn_about_middle(state: dict[str, Any], camera_id: str, renderer: Any) -> None:
    """Add the view angle to a serialised camera (VTK leaves it out), and move its focal point into the scene.

    Dragging turns about the focal point, which `look_through` puts one unit before the camera. Here it lies straight
    ahead, at the median depth of the points in front, which a few far points cannot move.
    """
    view = renderer.GetActiveCamera()
    position, forward = np.array(view.GetPosition()), np.array(view.GetDirectionOfProjection())
    meshes = [getattr(getattr(actor, "mapper", None), "dataset", None) for actor in _visible(renderer)]
    depths = [(np.asarray(mesh.points) - position) @ forward for mesh in meshes if mesh is not None]
    ahead = np.concatenate([np.zeros(0), *(depth[depth > 0] for depth in depths)])
    depth = float(np.median(ahead)) if len(ahead) else float(view.GetDistance())
    for part in _parts(state):
        if part["id"] == camera_id:
            part["properties"] |= {
                "viewAngle": view.GetViewAngle(),
                "focalPoint": (position + depth * forward).tolist(),
            }


def _visible(renderer: Any) -> list[Any]:
    return [actor for actor in renderer.actors.values() if actor.GetVisibility()]


def _parts(state: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield state
    for part in state.get("dependencies", ()):
        yield from _parts(part)


def _legend(labels: Tensor | Array | None, names: Sequence[str] | None) -> str:
    if labels is None or names is None:
        return ""
    present = [int(label) for label in np.unique(as_array(labels, "labels"))]
    check_names(present, names)
    lines = []
    for label, (red, green, blue) in zip(present, palette(np.array(present), names).tolist(), strict=True):
        name = html.escape("no class" if label < 0 else names[label])
        lines.append(f'<div><span style="{SWATCH}({red},{green},{blue})"></span>{name}</div>')
    return "\n".join(lines)


def _furnish(page: str, title: str, note: str, legend: str) -> str:
    """Replace the viewer's title, and add a box with the legend and the note."""
    page = re.sub(
        r"<title>.*?</title>", lambda _: f"<title>{html.escape(title)}</title>", page, count=1, flags=re.DOTALL
    )
    if not (note or legend):
        return page
    box = f'<div id="kfgs" style="{STYLE}">\n{legend}\n<div>{html.escape(note)}</div>\n</div>\n'
    # The viewer empties the body when it starts, so the box is added to the root element. "<\\/" does not end the script.
    text = json.dumps(box).replace("</", "<\\/")
    script = (
        '<script>addEventListener("DOMContentLoaded", () => '
        f'document.documentElement.insertAdjacentHTML("beforeend", {text}));</script>\n'
    )
    head, _, tail = page.partition("</head>")
    return f"{head}{script}</head>{tail}"
