"""Draw a mesh and keep it alive as long as its actor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyvista as pv


def draw_mesh(plotter: pv.Plotter, mesh: pv.PolyData, **options: Any) -> pv.Actor:
    """`plotter.add_mesh(mesh, **options)`, but `actor.mapper.dataset` stays valid as long as the actor lives.

    pyvista 0.49 holds only a weak reference, so the arrays of the mesh could be freed when the next one is drawn.
    """
    actor = plotter.add_mesh(mesh, **options)
    actor.AddObserver("DeleteEvent", lambda *_, mesh=mesh: mesh)  # the default argument holds the mesh
    return actor
