"""The lists of classes and texts that published protocols ask for: the JSON files in `data`."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any


@cache
def load_classes(name: str) -> dict[str, Any]:
    """One of the lists (legaussians, legaussians_views, lerf_ovs, scannet, scenesplat); "source" says what it is."""
    lists: dict[str, Any] = json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text("utf-8"))
    return lists
