"""The explorer: search two clouds side by side by class or text, in a window, a browser or a notebook."""

from .desktop import open_window
from .entry import explore
from .explorer import Explorer
from .hit_test import gaussian_at
from .html import save_html
from .meaning import Asked, FieldMeaning, Meaning, SplatMeaning
from .options import ExploreOptions
from .picked import Picked
from .session import Session
from .state import Exploration, Show
from .viewer import Viewer

__all__ = [
    "Asked",
    "Exploration",
    "ExploreOptions",
    "Explorer",
    "FieldMeaning",
    "Meaning",
    "Picked",
    "Session",
    "Show",
    "SplatMeaning",
    "Viewer",
    "explore",
    "gaussian_at",
    "open_window",
    "save_html",
]
