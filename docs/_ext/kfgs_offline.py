"""The built site asks no other machine for anything: whatever a page would load from elsewhere is a warning."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util import logging

# What a browser loads by itself. A link (<a href>) is followed only by a click.
LOADED = {
    "script": "src",
    "link": "href",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "use": "href",
}
say = logging.getLogger(__name__)


class Loaded(HTMLParser):
    """Collects what a page would load from another machine."""

    def __init__(self) -> None:
        super().__init__()
        self.outside: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look at one tag."""
        target = dict(attrs).get(LOADED.get(tag, "")) or ""
        if target.startswith(("http:", "https:", "//")):
            self.outside.append(f"<{tag}> {target}")


def find_outside(page: str) -> list[str]:
    """What the text of a page would load from another machine."""
    parser = Loaded()
    parser.feed(page)
    return parser.outside


def find_outside_style(sheet: str) -> list[str]:
    """What a style sheet would load from another machine."""
    return re.findall(r"(?:url\(\s*|@import\s+)[\"']?((?:https?:)?//[^\s\"')]+)", sheet)


def check(app: Sphinx, exception: Exception | None) -> None:
    """Warn about each page of the site that loads something from elsewhere."""
    if exception is None and app.builder.format == "html":
        for path in sorted(path for path in Path(app.outdir).rglob("*") if path.suffix in (".html", ".css")):
            find = find_outside if path.suffix == ".html" else find_outside_style
            for what in find(path.read_text(encoding="utf-8")):
                say.warning(f"{path.relative_to(app.outdir)}: expected files of the site alone, got {what}")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the check."""
    app.connect("build-finished", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
