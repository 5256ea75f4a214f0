"""The explorer: search two clouds side by side by class or text, in a window, a browser or a notebook."""

from .desktop import open_window
from .entry import explore
from .explorer import Explorer
from .hit_test import gaussian_at
from .html import save_html
from .meaning import Asked, FieldMeaning, Meaning, SplatMeaning
from .notebook import show_in_notebook
from .options import ExploreOptions
from .picked import Picked
from .state import Exploration, Show
from .web import serve

__all__ = [
    "Asked",
    "Exploration",
    "ExploreOptions",
    "Explorer",
    "FieldMeaning",
    "Meaning",
    "Picked",
    "Show",
    "SplatMeaning",
    "explore",
    "gaussian_at",
    "open_window",
    "save_html",
    "serve",
    "show_in_notebook",
]
