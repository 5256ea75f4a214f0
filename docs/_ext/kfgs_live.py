"""The viewer on the site, live: the page that `viewer.save_html` writes, of the scene that `pictures/live.py` made.

It is written once into the built site. `{kfgs-live}` on a page, or the tag `live` of a notebook's cell, shows it there.
"""

from __future__ import annotations

from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from kfgs import SemanticField, read_splats
from kfgs.viewer.meaning import FieldMeaning
from kfgs.viewer.state import Exploration
from kfgs.viewer.viewer import Viewer

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
PAGE = "_static/live.html"
FRAME = f'<iframe class="live" src="{{up}}{PAGE}" loading="lazy" title="The viewer, live"></iframe>'


def frame(docname: str) -> str:
    """The frame as HTML, for a page of the site."""
    return FRAME.format(up="../" * docname.count("/"))


class Live(SphinxDirective):
    """The viewer in a frame, which a browser loads when it comes into sight."""

    def run(self) -> list[nodes.Node]:
        """The frame, with the page's address as seen from here."""
        return [nodes.raw("", frame(self.env.docname), format="html")]


def write_page(app: Sphinx, exception: Exception | None) -> None:
    """Write the page next to the other files that pages load."""
    if exception is None and app.builder.format == "html":
        field, splat = SemanticField.load(PICTURES / "live.kfgs"), read_splats(PICTURES / "live.spz")
        state = Exploration(FieldMeaning(field, cameras=field.cameras), splat, cameras=field.cameras)
        Viewer(state, title="kfgs: a room").save_html(Path(app.outdir, PAGE))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive, and the page."""
    app.add_directive("kfgs-live", Live)
    app.connect("build-finished", write_page, priority=400)  # before kfgs_offline reads what was written
    return {"parallel_read_safe": True, "parallel_write_safe": True}
