"""The lists of classes and texts that published protocols ask for: package data in `kfgs/evaluation/data`."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from .._check import check_choice

VOID_NAMES = ("void", "unlabeled", "unlabelled", "unknown", "ignore")
"""Names that mean "no class": what has them is not scored."""
FILES = ("ade20k", "legaussians", "legaussians_views", "lerf_ovs", "scannet", "scenesplat")


@cache
def load_classes(name: str) -> dict[str, Any]:
    """One of the lists in `FILES`, as it is in its JSON file; "source" says what it is.

    Raises:
        ValueError: if there is no such list.

    Example:
        >>> load_classes("lerf_ovs")["texts"]["teatime"][:2]
        ['sheep', 'yellow pouf']
    """
    check_choice("name", name, FILES)
    found: dict[str, Any] = json.loads(files("kfgs.evaluation").joinpath("data", f"{name}.json").read_text("utf-8"))
    return found


def name_key(name: str) -> str:
    """A name as names are compared: without regard to case, spaces, hyphens and underscores.

    Data sets write one class in several ways: NYU40 has "showercurtain", SceneSplat-Bench "shower curtain".

    Example:
        >>> name_key("Shower-Curtain") == name_key("showercurtain")
        True
    """
    return name.casefold().translate(str.maketrans("", "", " -_"))
