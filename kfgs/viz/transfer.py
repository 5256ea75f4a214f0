"""The picture of Sec. 3.4: the colour cloud lifted over the semantic one, and lines that carry the labels up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._check import as_array
from ..cameras import Camera, as_cameras
from ..gaussians import Gaussians
from ..labels.selection import class_names
from ..labels.transfer import Sources, as_cloud, nearest_labels, positions
from .clouds import add_cloud, recolor_cloud
from .colors import Array, cloud_colors
from .legends import add_legend, letters
from .linked import evenly, look_over, upwards
from .plotter import draw_mesh, make_plotter

if TYPE_CHECKING:
    import pyvista as pv

    from ..fields import SemanticField

LINES = 500  # more lines than this hide the clouds
LIFT = 0.9  # of the upper cloud, as a share of the lower one's width: seen from obliquely above, they do not overlap
REACH = 3.0  # the slider ends at this many times lambda
SECTORS = 72  # around the cameras, in which walls are looked for
AROUND = 0.75  # of the sectors have a wall, or nothing encloses the cameras
THICK = 0.1  # of the walls, as a share of the median distance from the middle
NEARLY, NEIGHBOURS = 1.5, 4  # a label is disputed if one of so many sources, at most so much farther, has another class
ORPHANED, DISPUTED = np.array([[255, 0, 80], [255, 214, 0]], np.uint8)  # red and yellow


def show_transfer(
    field: SemanticField | Gaussians,
    splat: Gaussians,
    distance: float | None = None,
    *,
    cameras: Sequence[Camera] | None = None,
    whole: bool = False,
    height: int = 768,
    off_screen: bool | None = None,
) -> pv.Plotter:
    """Show how labels pass by distance: the colour cloud lifted over the semantic one, with lines between the two.

    Each line joins a colour Gaussian to the semantic one that gave it its class, in the colour of the class; 500 are drawn.
    Above, red has no label (no source is closer than lambda), and yellow is disputed: another class is nearly as near. The
    slider sets lambda. With the mouse over a Gaussian, the key P names it.

    Args:
        field: a semantic field, or labelled Gaussians.
        splat: the colour cloud, in the same frame (`kfgs.attach` finds it).
        distance: lambda at first, world units; None: as `nearest_labels` chooses it.
        cameras: views that tell where up is and what encloses them; None: those of the field.
        whole: with walls and ceiling; else without what encloses the cameras.
        height: of the window, pixels; it is as wide as high.
        off_screen: as in `make_plotter`.

    Returns:
        The plotter: call `.show()`, or add more first. Its mesh `transfer` holds the lines with `label`, `source`,
        `destination` and `distance`.

    Raises:
        ValueError: if a cloud is empty, has no labels or no colours, or the distance is not positive.
    """
    views = as_cameras(cameras or getattr(field, "cameras", ()))
    semantic, splat = as_cloud(field, "field", labelled=True), as_cloud(splat, "splat")
    if not (as_array(semantic.labels) >= 0).any():
        raise ValueError(f"field: expected Gaussians with a class, got none in {semantic!r}; choose other classes")
    if splat.sh is None or len(splat) == 0:
        raise ValueError(f"splat: expected Gaussians with colours, got {splat!r}; `read_splats` reads a colour cloud")
    semantic, splat = semantic.to("cpu"), splat.to("cpu").with_origin(semantic.origin)
    up = np.asarray(upwards(views))
    rows = [np.flatnonzero(whole | ~enclosing(cloud, views, up)) for cloud in (semantic, splat)]
    plotter = make_plotter(height, height, off_screen=off_screen)
    try:
        picture = _Picture(plotter, (semantic, splat), rows, distance, up)
        picture.draw(picture.distance)
        span, bar = (0.0, REACH * picture.distance), {"pointa": (0.62, 0.08), "pointb": (0.97, 0.08), "fmt": "%.3g"}
        plotter.add_slider_widget(picture.draw, span, value=picture.distance, color=letters(plotter), **bar)
        look_over(plotter, up.tolist())
    except BaseException:
        plotter.close()
        raise
    return plotter


class _Picture:
    """Draws both clouds once, and with every move of the slider what depends on lambda: colours, lines and counts."""

    def __init__(
        self, plotter: pv.Plotter, clouds: Sequence[Gaussians], rows: list[Array], distance: float | None, up: Array
    ) -> None:
        semantic, splat = clouds
        self.plotter, self.text = plotter, {"counts": "", "picked": ""}
        self.semantic_rows, self.color_rows = rows  # which Gaussians of each cloud are drawn
        self.classes = classes = as_array(semantic.labels)
        self.sources, targets = positions("field.means", semantic.means), as_array(splat.means).astype(np.float64)
        self.color_rows = self.color_rows[np.isfinite(targets[self.color_rows]).all(axis=1)]
        self.distance = nearest_labels(self.sources, classes, targets, distance).distance
        carried = nearest_labels(self.sources, classes, targets, REACH * self.distance)  # up to the slider's end
        self.labels, self.distances = as_array(carried.labels), as_array(carried.distances)
        self.givers, tree = as_array(carried.sources), Sources(self.sources, classes >= 0)
        nearest = range(1, min(NEIGHBOURS, len(tree.index)) + 1)
        far, neighbours = tree.tree.query(np.nan_to_num(targets), [*nearest], workers=-1)
        others = classes[tree.index[neighbours]] != self.labels[:, None]
        self.disputed = (others & (far < NEARLY * self.distances[:, None])).any(axis=1)

        self.names = [*class_names(semantic), "no class"]
        self.class_colors, self.own_colors = cloud_colors(semantic, "label").rgb, cloud_colors(splat, "rgb").rgb
        width = np.ptp(np.quantile(self.sources[self.semantic_rows], (0.02, 0.98), axis=0), axis=0).max()
        self.lifted = targets + LIFT * width * up
        above = splat.replace(means=torch.from_numpy(self.lifted).to(splat.means))
        # joined, because VTK does not mix two clouds, without what only one of them has
        parts = [semantic.select(self.semantic_rows), above.select(self.color_rows)]
        shapes = [Gaussians(part.means, part.quats, part.scales, part.opacities, origin=part.origin) for part in parts]
        self.cloud = add_cloud(plotter, Gaussians.cat(shapes), color_by="opacity", style="gaussians", on_pick=self.tell)
        add_legend(plotter, semantic.select(self.semantic_rows))

    def draw(self, distance: float) -> None:
        """Draw colours and lines for a lambda."""
        import pyvista as pv

        near = self.distances < distance
        unsure = near & self.disputed
        colors = np.select([~near[:, None], unsure[:, None]], [ORPHANED, DISPUTED], self.own_colors)
        recolor_cloud(self.cloud, np.concatenate([self.class_colors[self.semantic_rows], colors[self.color_rows]]))
        self.plotter.remove_actor("transfer")
        drawn = self.color_rows[near[self.color_rows]]
        if len(drawn):
            drawn = drawn[evenly(len(drawn), LINES)]
            givers = self.givers[drawn]
            ends = np.stack([self.lifted[drawn], self.sources[givers]], axis=1)
            mesh = pv.line_segments_from_points(ends.reshape(-1, 3).astype(np.float32))
            mesh.cell_data.update({"rgb": self.class_colors[givers], "label": self.labels[drawn], "source": givers})
            mesh.cell_data.update({"destination": drawn, "distance": self.distances[drawn]})
            draw_mesh(self.plotter, mesh, scalars="rgb", rgb=True, name="transfer", lighting=False, pickable=False)
        counts = f"{(~near).sum():,} without a label (red), {unsure.sum():,} disputed (yellow)"
        self._write("counts", f"lambda {distance:.3g}: {len(near):,} Gaussians, {counts}")

    def tell(self, row: int) -> None:
        """Write which Gaussian was picked, its class, and who gave it."""
        if row < 0:
            self._write("picked", "")
        elif row < len(self.semantic_rows):
            i = self.semantic_rows[row]
            self._write("picked", f"semantic Gaussian {i}: {self.names[self.classes[i]]}")
        else:
            i = self.color_rows[row - len(self.semantic_rows)]
            giver = f"from semantic Gaussian {self.givers[i]}, {self.distances[i]:.3g} away"
            self._write("picked", f"colour Gaussian {i}: {self.names[self.labels[i]]} {giver}")

    def _write(self, name: str, line: str) -> None:
        self.text[name] = line
        text, ink = "\n".join(self.text.values()), letters(self.plotter)
        self.plotter.add_text(text, position="upper_left", font_size=9, color=ink, name="transfer text")


def enclosing(gaussians: Gaussians, cameras: Sequence[Camera], up: Array) -> Array:  # [N] bool
    """Which Gaussians enclose the cameras: the walls, the ceiling and what is beyond them; none if walls are on one side only.

    In the middle, what is higher than all cameras is mostly ceiling; at their height, most is wall. So the ceiling is at a
    median of heights, and the wall of each sector at a median of distances, unless a camera is farther out.
    """
    if not cameras:
        return np.zeros(len(gaussians), dtype=bool)
    centers = np.stack([as_array(camera.with_origin(gaussians.origin).center) for camera in cameras]).astype(np.float64)
    middle, axes = np.median(centers, axis=0), np.vstack([np.linalg.svd(up[None])[2][1:], up])  # two level axes, and up
    x, y, z = axes @ (np.nan_to_num(as_array(gaussians.means)) - middle).T
    u, v, w = axes @ (centers - middle).T  # of the cameras
    out, camera_out = np.hypot(x, y), np.hypot(u, v)
    thick, overhead = THICK * np.median(out), z[(z > w.max()) & (out < np.median(out))]
    ceiling = np.median(overhead) if overhead.size else np.inf
    sector, seat = (((np.arctan2(b, a) / np.pi + 1) / 2 * SECTORS).astype(int) % SECTORS for a, b in ((x, y), (u, v)))
    at_eye_level, walls = (z > 0) & (z < ceiling - thick), np.full(SECTORS, np.inf)
    for k in range(SECTORS):
        distances = out[at_eye_level & (sector == k)]
        if distances.size and np.median(distances) > camera_out[seat == k].max(initial=0.0):  # seat: a camera's sector
            walls[k] = np.median(distances) - thick
    return ((out > walls[sector]) | (z > ceiling - thick)) & (np.isfinite(walls).mean() >= AROUND)
