"""Draw a mesh so that it can still be read from its actor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyvista as pv


def draw_mesh(plotter: pv.Plotter, mesh: pv.PolyData, **options: Any) -> pv.Actor:
    """`plotter.add_mesh(mesh, **options)`, and `actor.mapper.dataset` is that mesh as long as the actor lives.

    pyvista 0.49 refers to it weakly, so the arrays of a mesh that nobody else holds are freed when the next one is drawn.
    """
    actor = plotter.add_mesh(mesh, **options)
    actor.AddObserver("DeleteEvent", lambda *_, mesh=mesh: mesh)  # the closure holds it
    return actor
