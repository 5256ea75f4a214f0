"""More than one scene: what works over a whole collection of them.

Names are imported when first used: a search by a class name needs no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_WHERE = {
    "PartFound": ".search",
    "SceneFound": ".search",
    "SearchIndex": ".search",
    "SharedCodebook": ".shared_codebook",
}
__all__ = sorted(_WHERE)

if TYPE_CHECKING:
    from .search import PartFound as PartFound
    from .search import SceneFound as SceneFound
    from .search import SearchIndex as SearchIndex
    from .shared_codebook import SharedCodebook as SharedCodebook


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(import_module(_WHERE[name], __name__), name)
