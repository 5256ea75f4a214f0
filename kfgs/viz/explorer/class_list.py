"""The list of classes that the window and the page show, with a box to hide each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .state import Exploration

NO_CLASS = "no class"


def class_list(state: Exploration) -> list[tuple[int, str]]:
    """(label, name) of the classes in this scene, in label order, with -1 ("no class") last.

    With a colour cloud, -1 is always listed: lambda decides how many of its Gaussians have no class.
    """
    labels = state.labels("semantic")
    rows = [(int(label), state.meaning.names[label]) for label in np.unique(labels[labels >= 0])]
    if len(state.sides) > 1 or (labels < 0).any():
        rows.append((-1, NO_CLASS))
    return rows
