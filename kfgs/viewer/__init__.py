"""The viewer: search two clouds side by side by class or text, in a browser, a notebook, a window or a picture."""

from .meaning import FieldMeaning as FieldMeaning
from .meaning import SplatMeaning as SplatMeaning
from .state import Exploration as Exploration
from .viewer import Viewer, explore
from .window import Explorer

__all__ = ["Explorer", "Viewer", "explore"]
