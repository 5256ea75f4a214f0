"""The viewer's page: its JavaScript as one plain script, the HTML around it, and the exported file that works offline."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files

from .pack import Packed

# a module comes after those that it imports
RENDERER = ("sorter.js", "tint.js", "clouds.js", "shaders.js", "gl.js", "pick.js", "renderer.js")
INTERFACE = (
    "eye.js", "link.js", "model.js", "dom.js", "marks.js", "panel.js", "tools.js", "panes.js", "chrome.js", "app.js",
    "start.js",
)  # fmt: skip
APP = (*RENDERER, *INTERFACE)

# Nothing may be loaded: pictures and the worker are made in the page.
POLICY = "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; style-src 'unsafe-inline'; img-src blob: data:"
_IMPORT = re.compile(r"""^import\s*\{([^}]*)\}\s*from\s*["']\./(\w+)\.js["'];?[ \t]*$""", re.M)
_EXPORT = re.compile(r"^export\s+(?=(?:async\s+)?(?:function\*?|class|const|let)\s+(\w+))", re.M)


def document(title: str, packed: Packed | None = None) -> str:
    """The page (page.html) with the viewer's script and style; with a scene, it loads nothing, else it asks Python for one."""
    parts = {"title": html.escape(title), "style": read_text("app.css"), "script": inline_script(APP)}
    parts |= {"data": "", "policy": ""}
    if packed is not None:
        header = json.dumps(packed.header, separators=(",", ":")).replace(
            "<", "\\u003c"
        )  # names may contain "</script>"
        parts["data"] = f"""\
<script type="application/json" id="header">{header}</script>
<script type="text/plain" id="data">{base64.b64encode(packed.compressed()).decode()}</script>"""
        parts["policy"] = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    return re.sub(r"\{(\w+)\}", lambda place: parts[place[1]], read_text("page.html"))


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
