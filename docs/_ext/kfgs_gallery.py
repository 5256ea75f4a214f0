"""The gallery: shows every .ipynb of `notebooks/`, with the outputs that are in the file; without any, it says so."""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx

PAGES = Path(__file__).resolve().parents[1] / "gallery"
NOTEBOOKS = PAGES.parents[1] / "notebooks"
NONE = """```{note}
No executed notebook lies in `notebooks/` of this checkout. `python notebooks/run.py` runs them all.
```
"""


def bring(notebooks: Path, pages: Path) -> list[str]:
    """Copy the notebooks to where Sphinx reads, write the list of them, and return their names."""
    paths = sorted(notebooks.glob("[0-9]*_*.ipynb"), key=lambda path: int(path.name.split("_")[0]))
    found = {path.name: path.read_bytes() for path in paths}
    for old in pages.glob("*.ipynb"):
        if old.name not in found:
            old.unlink()
    for name, content in found.items():
        if not (pages / name).is_file() or (pages / name).read_bytes() != content:  # else Sphinx reads it again
            (pages / name).write_bytes(content)
    names = [name.removesuffix(".ipynb") for name in found]
    listed = "```{toctree}\n:maxdepth: 1\n\n" + "\n".join(names) + "\n```\n" if names else NONE
    place = pages / "list.inc"
    if not place.is_file() or place.read_text(encoding="utf-8") != listed:
        place.write_text(listed, encoding="utf-8")
    return names


def setup(app: Sphinx) -> dict[str, bool]:
    """Bring the notebooks before Sphinx looks for pages."""
    bring(NOTEBOOKS, PAGES)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
