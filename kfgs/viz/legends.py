"""What the colours of a 3-D picture mean: classes by name, scores along a bar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from .cloud_colors import COLORMAP
from .pictures import LEGEND_INK, LEGEND_PAPER, legend_column

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
LEGEND_MARGIN = 10  # pixels from the corner
DARK = 0.5  # of a background on which letters are white


def add_legend(
    plotter: pv.Plotter,
    labels: Tensor | Array,  # any shape, int
    names: Sequence[str],
) -> Any:
    """List the classes present, by name and colour, in the lower left corner of the active subplot.

    A small picture instead of pyvista's legend, which writes each name in its own colour: yellow on white.

    Raises:
        ValueError: if a label has no name.
    """
    picture = legend_column(labels, names)
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    height, width, _ = picture.shape
    image = pv.ImageData(dimensions=(width, height, 1))
    image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
    image.set_active_scalars("rgb")
    mapper = vtkImageMapper()
    mapper.SetInputData(image)
    mapper.SetColorWindow(255)
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    actor.SetPosition(LEGEND_MARGIN, LEGEND_MARGIN)
    plotter.add_actor(actor, reset_camera=False, pickable=False)
    return actor


def add_scalar_bar(plotter: pv.Plotter, cloud: pv.Actor | tuple[float, float], title: str = "score") -> Any:
    """Say which colour stands for which number, in a bar on the right of the active subplot.

    Args:
        plotter: where the cloud is.
        cloud: what `add_cloud` returned for scores or opacities; or the numbers of the darkest and the brightest colour.
        title: over the bar.

    Raises:
        ValueError: if the cloud's colours stand for no numbers.
    """
    clim = cloud if isinstance(cloud, tuple) else cloud.mapper.dataset.field_data.get("clim")
    if clim is None:
        raise ValueError(
            "cloud: expected one coloured by scores or opacity, got one without a scale; use add_legend for labels"
        )
    import pyvista as pv
    from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor

    bar = vtkScalarBarActor()
    bar.SetLookupTable(pv.LookupTable(COLORMAP, scalar_range=tuple(float(end) for end in clim)))
    bar.SetTitle(title)
    bar.SetNumberOfLabels(5)
    bar.SetLabelFormat("{:.3g}")
    bar.SetUnconstrainedFontSize(True)
    for text, size in ((bar.GetTitleTextProperty(), 16), (bar.GetLabelTextProperty(), 14)):
        text.SetColor(*(part / 255 for part in LEGEND_INK))
        text.SetFontSize(size)
        text.SetItalic(False)
        text.SetBold(False)
        text.SetShadow(False)
    bar.SetMaximumNumberOfColors(256)
    bar.SetVerticalTitleSeparation(10)
    bar.SetTextPad(4)
    bar.SetDrawBackground(True)
    bar.GetBackgroundProperty().SetColor(*(part / 255 for part in LEGEND_PAPER))
    bar.SetPosition(0.83, 0.15)
    bar.SetWidth(0.15)
    bar.SetHeight(0.7)
    plotter.add_actor(bar, reset_camera=False, pickable=False)
    return bar


def letters(plotter: pv.Plotter) -> tuple[float, float, float]:
    """A colour for text that can be read on the active subplot's background."""
    dark = np.mean(plotter.renderer.GetBackground()) < DARK
    ink = (255, 255, 255) if dark else LEGEND_INK
    return (ink[0] / 255, ink[1] / 255, ink[2] / 255)
