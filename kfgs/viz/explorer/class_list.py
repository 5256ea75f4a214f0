"""The classes that a window or a page lists, each with a box that hides it: one list for every face."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .state import Exploration

NO_CLASS = "no class"


def class_list(state: Exploration) -> list[tuple[int, str]]:
    """(label, name) of the classes in this scene, in label order, and last -1 for what has none.

    With a colour cloud -1 is always there: whether one of its Gaussians has a class depends on lambda.
    """
    labels = state.labels("semantic")
    rows = [(int(label), state.meaning.names[label]) for label in np.unique(labels[labels >= 0])]
    if len(state.sides) > 1 or (labels < 0).any():
        rows.append((-1, NO_CLASS))
    return rows
