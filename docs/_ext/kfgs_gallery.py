"""The gallery: every .ipynb of `notebooks/` as a page with the outputs that are in the file, and a card with a picture for each.

The picture is that of the cell with the tag `thumbnail`, or else the last one. The text is the first bold sentence.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

from kfgs_live import frame
from sphinx.application import Sphinx

PAGES = Path(__file__).resolve().parents[1] / "gallery"
NOTEBOOKS = PAGES.parents[1] / "notebooks"
SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png"}
NONE = """```{note}
No executed notebook lies in `notebooks/` of this checkout. `python notebooks/run.py` runs them all.
```
"""


def bring(notebooks: Path, pages: Path) -> list[str]:
    """Copy the notebooks to where Sphinx reads, write the list of them, and return their names."""
    paths = sorted(notebooks.glob("[0-9]*_*.ipynb"), key=lambda path: int(path.name.split("_")[0]))
    files: dict[str, bytes] = {}
    cards = []
    for path in paths:
        notebook = json.loads(path.read_bytes())
        card, picture = _card(path.stem, notebook)
        for cell in notebook["cells"]:
            if "live" in cell["metadata"].get("tags", []):  # the viewer itself, in place of its still picture
                shown = {"text/html": frame(f"{pages.name}/{path.stem}")}
                cell["outputs"] = [{"output_type": "display_data", "data": shown, "metadata": {}}]
        files[path.name] = json.dumps(notebook).encode()
        cards.append(card)
        files |= picture
    for old in [*pages.glob("*.ipynb"), *pages.glob("card_*")]:
        if old.name not in files:
            old.unlink()
    names = [path.stem for path in paths]
    hidden = "```{toctree}\n:hidden:\n\n" + "\n".join(names) + "\n```\n"
    listed = "::::{grid} 1 2 2 3\n:gutter: 3\n\n" + "\n".join(cards) + "::::\n\n" + hidden if names else NONE
    for name, content in {**files, "list.inc": listed.encode()}.items():
        if not (pages / name).is_file() or (pages / name).read_bytes() != content:  # else Sphinx reads it again
            (pages / name).write_bytes(content)
    return names


def _card(name: str, notebook: dict[str, Any]) -> tuple[str, dict[str, bytes]]:
    """A card as Markdown, and its picture as a file; no file if the notebook shows no picture."""
    texts = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "markdown"]
    title = next((line[2:] for text in texts for line in text.splitlines() if line.startswith("# ")), name)
    question = next((match[1] for text in texts if (match := re.search(r"\*\*(.+?)\*\*", text, re.DOTALL))), "")
    shown = [
        (cell["metadata"].get("tags", []), f"card_{name}{SUFFIXES[kind]}", data[kind])
        for cell in notebook["cells"]
        for data in (output.get("data", {}) for output in cell.get("outputs", []))
        for kind in SUFFIXES
        if kind in data
    ]
    chosen = [picture for picture in shown if "thumbnail" in picture[0]] or shown
    lines = [f":::{{grid-item-card}} {title}", f":link: {name}", ":link-type: doc"]
    picture = {chosen[-1][1]: base64.b64decode("".join(chosen[-1][2]))} if chosen else {}
    lines += [f":img-top: {file}\n:img-alt: {title}" for file in picture]
    return "\n".join([*lines, "", " ".join(question.split()), ":::", ""]), picture


def setup(app: Sphinx) -> dict[str, bool]:
    """Bring the notebooks before Sphinx looks for pages."""
    bring(NOTEBOOKS, PAGES)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
