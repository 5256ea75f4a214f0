"""The state of an exploration in numbers, for a file, and in words, for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .picked import SPOKEN

if TYPE_CHECKING:
    from .exploration import Exploration


def facts_of(state: Exploration) -> dict[str, Any]:
    """Question, gamma, lambda, and of each side how many Gaussians are what; as JSON.

    Classes are [name, count] pairs in label order, as two may have the same name.
    """
    facts: dict[str, Any] = {
        "words": None if state.asked is None else state.asked.words,
        "gamma": state.gamma,
        "gamma_how": state.gamma_how,
        "by": state.meaning.by,
    }
    if "color" in state.sides:
        facts |= {"lambda": state.distance, "lambda_how": state.distance_how}
    for side in state.sides:
        labels = state.labels(side)
        counts = np.bincount(labels + 1, minlength=len(state.meaning.names) + 1)
        facts[side] = {
            "total": len(labels),
            "selected": int(state.selected(side).sum()),
            "classes": [[name, int(count)] for name, count in zip(state.meaning.names, counts[1:], strict=True)],
            "none": int(counts[0]),
        }
    if "color" in state.sides:
        facts["color"]["orphaned"] = facts["color"]["none"]
    return facts


def lines_of(state: Exploration) -> list[str]:
    """The question with gamma, how many of each side, and lambda."""
    lines = []
    if state.asked is not None:
        lines.append(f"{state.asked.words!r}: score > {state.gamma:.3g} ({state.gamma_how})")
    for side in state.sides:
        total, chosen = len(state.cloud(side)), ""
        if state.asked is not None:
            chosen = f"{int(state.selected(side).sum()):,} of "
        lines.append(f"{SPOKEN[side]}: {chosen}{total:,} Gaussians")
    if "color" in state.sides:
        orphaned = int((state.labels("color") < 0).sum())
        lines.append(f"lambda {state.distance:.3g} ({state.distance_how}), {orphaned:,} out of reach")
    return lines
