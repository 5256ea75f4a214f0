"""The viewer in the browser: its JavaScript, which becomes one plain script for the page, the notebook and the exported file.

Nothing here imports torch, so that `kfgs view` shows its page at once.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.resources import files

RENDERER = ("sorter.js", "camera.js", "tint.js", "clouds.js", "shaders.js", "gl.js", "pick.js", "renderer.js")
"""The modules of the renderer; a module comes after those that it imports."""
INTERFACE = (
    "eye.js", "link.js", "points.js", "model.js", "dom.js", "boxes.js", "panel.js", "tools.js", "panes.js", "chrome.js", "app.js",
)  # fmt: skip
APP = (*RENDERER, *INTERFACE)
"""The renderer and the interface."""

_IMPORT = re.compile(r"""^import\s*\{([^}]*)\}\s*from\s*["']\./([\w.]+)["'];?[ \t]*$""", re.M)
_EXPORT = re.compile(r"^export\s+(?=(?:async\s+)?(?:function\*?|class|const|let)\s+(\w+))", re.M)


def read_text(name: str) -> str:
    """The text of a file of this folder."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def inline_script(modules: Sequence[str] = RENDERER, name: str = "kfgs") -> str:
    """Join modules to one classic script, which also works from file://, where no module can be imported.

    The script defines one constant with all that the modules export. Modules may use `import {a, b} from "./other.js"`
    and `export` in front of a function, a class or a constant; nothing else of the module syntax.

    Args:
        modules: files of this folder; a module comes after those that it imports.
        name: of the constant.

    Raises:
        ValueError: if a module imports one that does not come before it, or uses other syntax.
    """
    parts: list[str] = []
    for position, module in enumerate(modules):
        text = read_text(module)
        missing = [other for _, other in _IMPORT.findall(text) if other not in modules[:position]]
        if missing:
            raise ValueError(f"modules: expected {missing[0]} before {module}, which imports it; change the order")
        exported = _EXPORT.findall(text)
        text = _IMPORT.sub(lambda found: f"const {{{found[1].replace(' as ', ': ')}}} = {_variable(found[2])};", text)
        text = _EXPORT.sub("", text)
        if left := re.search(r"^(?:import|export)\b.*$", text, re.M):
            raise ValueError(f"{module}: expected named imports and exports only, got {left[0]!r}")
        parts.append(f"const {_variable(module)} = (() => {{\n{text}\nreturn {{{', '.join(exported)}}};\n}})();")
    everything = ", ".join(f"...{_variable(module)}" for module in modules)
    body = "\n".join(parts)
    script = f'const {name} = (() => {{\n"use strict";\n{body}\nreturn {{{everything}}};\n}})();\n'
    return script.replace("</script", "<\\/script")


def _variable(module: str) -> str:
    return "$" + module.removesuffix(".js").replace("-", "_").replace(".", "_")
