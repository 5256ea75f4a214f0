"""Write an exploration as one web page that works offline, without Python."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

from .._files import as_path, atomic_path
from ..scenes import Scene
from ..viz.shows import Photos
from .document import OFFLINE_START, POLICY, document
from .pack import Packed, pack_scene
from .server import pack_message
from .state import Exploration

PHOTO = 400  # pixels: the longer edge of a photo in the page, about 20 KB


def save_html(
    exploration: Exploration,
    path: str | Path,
    *,
    title: str = "kfgs",
    scene: Scene | None = None,
) -> Path:
    """Write one file with the scene and the viewer. It opens with a double click and loads nothing.

    Classes can be searched, gamma and lambda changed, Gaussians selected and edited. New phrases need Python.

    Args:
        exploration: the page opens with its question, gamma, lambda and hidden classes.
        path: a name that ends in .html.
        title: title of the page.
        scene: has the photos of the exploration's cameras, found by name; None: without photos.

    Returns:
        The path.

    Raises:
        ValueError: if the name does not end in .html.
    """
    target = as_path(path)
    if target.suffix.lower() != ".html":
        raise ValueError(f"path: expected a name that ends in .html, got {target.name!r}; rename it")
    packed = pack_view(exploration, title=title, scene=scene)
    data = f"""\
<script type="application/json" id="header">{_json(packed.header)}</script>
<script type="text/plain" id="data">{base64.b64encode(packed.compressed()).decode()}</script>"""
    policy = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    page = document(title, OFFLINE_START, data, policy)
    with atomic_path(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def scene_for_page(exploration: Exploration, *, title: str = "kfgs", scene: Scene | None = None) -> bytes:
    """What `PageServer.show` takes; arguments as in `save_html`."""
    return pack_message(*pack_view(exploration, title=title, scene=scene))


def pack_view(exploration: Exploration, *, title: str = "kfgs", scene: Scene | None = None) -> Packed:
    """Pack an exploration with the photos of its cameras, and what it shows now; arguments as in `save_html`."""
    asked = exploration.asked
    questions = [*exploration.meaning.names, *([] if asked is None or asked.known else [asked.words])]
    taken = None if scene is None else Photos(scene)
    small = [camera.fitted(PHOTO) for camera in exploration.cameras]
    photos = [] if taken is None else [taken(camera) if camera in taken else None for camera in small]
    packed = pack_scene(exploration, title=title, questions=questions, thumbnails=photos)
    return packed._replace(header=packed.header | {"start": _start(exploration)})


def _start(exploration: Exploration) -> dict[str, Any]:
    """What the page shows first."""
    asked, show = exploration.asked, exploration.show
    return {
        "show": "color" if show == "rgb" else show,
        "hidden": sorted(exploration.hidden),
        "words": None if asked is None else asked.words,
        "gamma": exploration.gamma,
    }


def _json(value: object) -> str:
    """JSON inside a script element: class names may contain "</script>"."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
