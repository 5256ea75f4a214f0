"""Write an exploration as one web page that works offline, without Python."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..._files import atomic_path
from ...cameras import Camera
from ...scenes import Scene
from ..pictures import as_bytes
from ..web import APP, inline_script, read_text
from .carried import Array
from .pack import pack_scene
from .state import Exploration

# Nothing may be loaded: pictures and the worker are made in the page.
POLICY = "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; style-src 'unsafe-inline'; img-src blob: data:"
PHOTO = 400  # pixels: the longer edge of a photo in the page, about 20 KB
START = """\
addEventListener("DOMContentLoaded", async () => {
  const root = document.getElementById("kfgs");
  try {
    const text = (id) => document.getElementById(id).textContent;
    const bytes = Uint8Array.from(atob(text("data")), (letter) => letter.charCodeAt(0));
    document.getElementById("data").remove();
    const header = JSON.parse(text("header"));
    const packed = { header, data: await kfgs.inflate(bytes, header) };
    window.viewer = await kfgs.mount(root, packed, new kfgs.OfflineLink(packed));
  } catch (error) {
    if (!root.childElementCount) root.textContent = `This scene cannot be shown: ${error.message}`;
  }
});
"""
PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{title}</title>
<style>
html, body {{ height: 100%; margin: 0; }}
{style}
</style>
</head>
<body>
<div id="kfgs"></div>
<script type="application/json" id="header">{header}</script>
<script type="text/plain" id="data">{data}</script>
<script>
{script}
{start}
</script>
</body>
</html>
"""


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
    target = Path(path)
    if target.suffix.lower() != ".html":
        raise ValueError(f"path: expected a name that ends in .html, got {target.name!r}; rename it")
    asked = exploration.asked
    questions = [*exploration.meaning.names, *([] if asked is None or asked.known else [asked.words])]
    photos = [] if scene is None else [_photo(scene, camera) for camera in exploration.cameras]
    packed = pack_scene(exploration, title=title, questions=questions, thumbnails=photos)
    page = PAGE.format(
        policy=POLICY,
        title=html.escape(title),
        style=read_text("app.css"),
        header=_json(packed.header | {"start": _start(exploration)}),
        data=base64.b64encode(packed.compressed()).decode(),
        script=inline_script(APP),
        start=START,
    )
    with atomic_path(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _start(exploration: Exploration) -> dict[str, Any]:
    """What the page shows first."""
    asked, show = exploration.asked, exploration.show
    return {
        "show": "color" if show == "rgb" else show,
        "hidden": sorted(exploration.hidden),
        "words": None if asked is None else asked.words,
        "gamma": exploration.gamma,
    }


def _photo(scene: Scene, camera: Camera) -> Array | None:  # [h, w, 3] uint8
    """A small photo of a camera; None if the scene has no camera of this name."""
    found = [index for index, own in enumerate(scene.cameras) if own.name == camera.name]
    if not found:
        return None
    picture = Image.fromarray(as_bytes(scene.image(found[0])))
    picture.thumbnail((PHOTO, PHOTO))
    return np.asarray(picture)


def _json(value: object) -> str:
    """JSON inside a script element: class names may contain "</script>"."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
