"""The viewer's page: its JavaScript as one plain script, the HTML around it, and the exported file that works offline."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from .._files import atomic_path
from ..scenes import Scene
from ..viz.pictures import check_suffix
from .pack import pack_scene
from .state import Exploration

# a module comes after those that it imports
RENDERER = ("sorter.js", "tint.js", "clouds.js", "shaders.js", "gl.js", "pick.js", "renderer.js")
INTERFACE = (
    "eye.js", "link.js", "model.js", "dom.js", "boxes.js", "panel.js", "tools.js", "panes.js", "chrome.js", "app.js",
    "shared.js",
)  # fmt: skip
APP = (*RENDERER, *INTERFACE)

# Nothing may be loaded: pictures and the worker are made in the page.
POLICY = "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; style-src 'unsafe-inline'; img-src blob: data:"
OFFLINE_START = """\
    const text = (id) => document.getElementById(id).textContent;
    const bytes = Uint8Array.from(atob(text("data")), (letter) => letter.charCodeAt(0));
    document.getElementById("data").remove();
    const header = JSON.parse(text("header"));
    const packed = { header, data: await kfgs.inflate(bytes, header) };
    window.viewer = await kfgs.mount(root, packed, new kfgs.OfflineLink(packed));"""
PYTHON_START = """\
    root.textContent = "Loading the scene…";
    const loaded = await fetch("pack").catch(() => null);
    root.textContent = "";
    if (!loaded?.ok) throw new Error("Python does not answer; its terminal says why.");
    const [header, data] = kfgs.readMessage(await loaded.arrayBuffer());
    window.viewer = await kfgs.mount(root, { header, data }, new kfgs.PythonLink(kfgs.callPage, { header, data }));"""
ROOT = '<div id="kfgs"></div>'
"""Holds the viewer, and shows that a page is one of kfgs."""
PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<link rel="icon" href="data:,">
<meta name="viewport" content="width=device-width, initial-scale=1">
{policy}
<title>{title}</title>
<style>
html, body {{ height: 100%; margin: 0; }}
{style}
</style>
</head>
<body>
{root}
{data}
<script>
{script}
addEventListener("DOMContentLoaded", async () => {{
  const root = document.getElementById("kfgs");
  try {{
{start}
  }} catch (error) {{
    if (!root.childElementCount) root.textContent = `This scene cannot be shown: ${{error.message}}`;
  }}
}});
</script>
</body>
</html>
"""
_IMPORT = re.compile(r"""^import\s*\{([^}]*)\}\s*from\s*["']\./(\w+)\.js["'];?[ \t]*$""", re.M)
_EXPORT = re.compile(r"^export\s+(?=(?:async\s+)?(?:function\*?|class|const|let)\s+(\w+))", re.M)


def document(title: str, start: str = PYTHON_START, data: str = "", policy: str = "") -> str:
    """The page: the viewer's script and style, `data` elements, and the JavaScript that loads a scene into `root`."""
    parts = {"title": html.escape(title), "style": read_text("app.css"), "script": inline_script(APP)}
    return PAGE.format(root=ROOT, start=start, data=data, policy=policy, **parts)


def save_html(exploration: Exploration, path: str | Path, *, title: str = "kfgs", scene: Scene | None = None) -> Path:
    """Write one file with the scene and the viewer. It opens with a double click and loads nothing.

    The page opens with the question, gamma and lambda of the exploration. `scene` has the photos of its cameras.
    """
    target = check_suffix(path, ".html")
    packed = pack_scene(exploration, title=title, scene=scene)
    header = json.dumps(packed.header, separators=(",", ":")).replace("<", "\\u003c")  # names may contain "</script>"
    data = f"""\
<script type="application/json" id="header">{header}</script>
<script type="text/plain" id="data">{base64.b64encode(packed.compressed()).decode()}</script>"""
    policy = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    with atomic_path(target) as temporary:
        temporary.write_text(document(title, OFFLINE_START, data, policy), encoding="utf-8")
    return target


def read_text(name: str) -> str:
    """The text of a file of this folder."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def inline_script(modules: Sequence[str] = RENDERER, name: str = "kfgs") -> str:
    """Join modules to one classic script, which also works from file://, where no module can be imported.

    The script defines one constant, `name`, with all that the modules export. Modules may use `import {a, b} from
    "./other.js"` and `export` in front of a function, a class or a constant; nothing else of the module syntax. A module
    comes after those that it imports.
    """
    parts: list[str] = []
    stems = [module.removesuffix(".js") for module in modules]
    for stem in stems:
        text = read_text(f"{stem}.js")
        exported = _EXPORT.findall(text)
        text = _IMPORT.sub(lambda match: f"const {{{match[1].replace(' as ', ': ')}}} = ${match[2]};", text)
        text = _EXPORT.sub("", text)
        parts.append(f"const ${stem} = (() => {{\n{text}\nreturn {{{', '.join(exported)}}};\n}})();")
    everything = ", ".join(f"...${stem}" for stem in stems)
    body = "\n".join(parts)
    script = f'const {name} = (() => {{\n"use strict";\n{body}\nreturn {{{everything}}};\n}})();\n'
    return script.replace("</script", "<\\/script")
