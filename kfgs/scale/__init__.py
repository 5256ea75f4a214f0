"""More than one machine, more than one scene, and scenes that do not fit into one machine.

Names are imported when first used: a search by a class name needs no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_WHERE = {
    "FieldInBlocks": ".in_blocks",
    "Found": ".search_found",
    "PartFound": ".search_found",
    "SceneFound": ".search_found",
    "SearchIndex": ".search",
    "SharedCodebook": ".shared_codebook",
    "fit_block": ".blocks",
    "fit_blocks": ".blocks",
    "split_scene": ".blocks",
}
__all__ = sorted(_WHERE)

if TYPE_CHECKING:
    from .blocks import fit_block as fit_block
    from .blocks import fit_blocks as fit_blocks
    from .blocks import split_scene as split_scene
    from .in_blocks import FieldInBlocks as FieldInBlocks
    from .search import SearchIndex as SearchIndex
    from .search_found import Found as Found
    from .search_found import PartFound as PartFound
    from .search_found import SceneFound as SceneFound
    from .shared_codebook import SharedCodebook as SharedCodebook


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(import_module(_WHERE[name], __name__), name)
