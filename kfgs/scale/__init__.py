"""More than one machine, more than one scene, and scenes that do not fit into one machine.

Names are imported when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_WHERE = {
    "BatchOptions": ".options",
    "FieldInBlocks": ".in_blocks",
    "SceneEntry": ".scene_list",
    "SceneResult": ".batch",
    "fit_block": ".blocks",
    "fit_blocks": ".blocks",
    "map_scenes": ".batch",
    "open_client": ".clients",
    "read_scenes": ".scene_list",
    "run_batch": ".batch",
    "split_scene": ".blocks",
}
__all__ = sorted(_WHERE)

if TYPE_CHECKING:
    from .batch import SceneResult as SceneResult
    from .batch import map_scenes as map_scenes
    from .batch import run_batch as run_batch
    from .blocks import fit_block as fit_block
    from .blocks import fit_blocks as fit_blocks
    from .blocks import split_scene as split_scene
    from .clients import open_client as open_client
    from .in_blocks import FieldInBlocks as FieldInBlocks
    from .options import BatchOptions as BatchOptions
    from .scene_list import SceneEntry as SceneEntry
    from .scene_list import read_scenes as read_scenes


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(import_module(_WHERE[name], __name__), name)
