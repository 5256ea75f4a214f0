"""The explorer: search two clouds side by side by class or text, in a window, a browser or a notebook."""

from .desktop import open_window
from .entry import explore
from .explorer import Explorer
from .hit_test import Sight, gaussian_at, neighbours_of, views_seeing
from .meaning import Asked, FieldMeaning, Meaning, SplatMeaning
from .notebook import show_in_notebook
from .options import ExploreOptions
from .picked import Picked, Side
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
    "Side",
    "Sight",
    "SplatMeaning",
    "explore",
    "gaussian_at",
    "neighbours_of",
    "open_window",
    "serve",
    "show_in_notebook",
    "views_seeing",
]
