"""One origin for all that is drawn in a plotter: that of what is drawn first. VTK draws float32, as all graphics do."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar
from weakref import WeakKeyDictionary

from .._origin import Origin
from ..cameras import Camera
from ..gaussians import Gaussians, check_gaussians

if TYPE_CHECKING:
    import pyvista as pv

Thing = TypeVar("Thing", Gaussians, Camera)
_origins: WeakKeyDictionary[pv.Plotter, Origin] = WeakKeyDictionary()


def origin_of(plotter: pv.Plotter, first: Origin) -> Origin:
    """The origin that is drawn in the plotter; if nothing is yet, `first` becomes it."""
    return _origins.setdefault(plotter, first)


def placed(plotter: pv.Plotter, thing: Thing) -> Thing:
    """Gaussians or a camera, counted from the plotter's origin; a TypeError if it is neither."""
    if not isinstance(thing, Camera):
        check_gaussians(thing)
    return thing.with_origin(origin_of(plotter, thing.origin))
