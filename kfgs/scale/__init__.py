"""More than one scene: what works over a whole collection of them.

Names are imported when first used: a search by a class name needs no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_WHERE = {
    "Found": ".search_found",
    "PartFound": ".search_found",
    "SceneFound": ".search_found",
    "SearchIndex": ".search",
    "SharedCodebook": ".shared_codebook",
}
__all__ = sorted(_WHERE)

if TYPE_CHECKING:
    from .search import SearchIndex as SearchIndex
    from .search_found import Found as Found
    from .search_found import PartFound as PartFound
    from .search_found import SceneFound as SceneFound
    from .shared_codebook import SharedCodebook as SharedCodebook


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(import_module(_WHERE[name], __name__), name)
