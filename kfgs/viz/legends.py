"""Legends in a 3-D picture: class names with colours, or a bar of scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .._check import as_array, check_range
from .._typed import typed
from .cloud_colors import COLORMAP
from .clouds import cloud_of
from .pictures import LEGEND_INK, LEGEND_PAPER, check_names, legend_column

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
MARGIN = 10  # pixels from a corner
DARK = 0.5  # brightness of a background; below it, letters are white
LETTERS = 14  # pixels, in windows up to 770 pixels high; higher windows have larger letters
SMALLEST = 9  # pixels: the smallest size that can be read
BAR = 0.6  # share of the subplot's height


def add_legend(
    plotter: pv.Plotter,
    labels: Tensor | Array,  # any shape, int
    names: Sequence[str],
    *,
    colors: Array | None = None,  # [C, 3] uint8
) -> Any:
    """List the classes present, by name and colour, in the lower left corner of the active subplot.

    It is a small picture. pyvista's own legend writes each name in its colour, for instance yellow on white. If the
    subplot is too low for all classes, the letters shrink to at least 9 pixels, then the list gets several columns.

    Colours are those of `palette(labels, names)`: draw the cloud with `color_by=palette(labels, names)`, or pass the `colors`
    of each class.

    Raises:
        ValueError: if there is no label, or one has no name.
        TypeError: if `names` is no list of names.
    """
    present = np.unique(as_array(labels, "labels"))
    if present.size == 0:
        raise ValueError("labels: expected at least one to list, got none; leave the legend out")
    check_names(present.tolist(), names)  # now, and not only while a frame is drawn

    def draw(height: int, width: int) -> Array:
        room = height - 2 * MARGIN
        for size in range(letter_size(height), SMALLEST, -1):
            picture = legend_column(present, names, size, colors=colors)
            if len(picture) <= room:
                return picture
        return legend_column(present, names, SMALLEST, height=room, colors=colors)

    return pin_picture(plotter, draw)


@typed
def add_scalar_bar(plotter: pv.Plotter, cloud: pv.Actor | tuple[float, float], title: str = "score") -> Any:
    """Draw a colour bar with numbers in the lower right corner of the active subplot.

    Args:
        plotter: where the cloud is.
        cloud: the actor from `add_cloud`, coloured by scores or opacity; or the numbers of the darkest and the brightest
            colour.
        title: over the bar, in lines at most a fifth of the subplot wide.

    Raises:
        ValueError: if the cloud is not coloured by numbers, or two numbers do not ascend.
    """
    clim = cloud if isinstance(cloud, tuple | list) else cloud_of("cloud", cloud).field_data.get("clim")
    if clim is None:
        raise ValueError(
            "cloud: expected one coloured by scores or opacity, got one without a scale; use add_legend for labels"
        )
    low, high = (float(end) for end in clim)
    check_range("cloud (its darkest)", low, -np.inf, closed=(False, False))
    check_range("cloud (its brightest)", high, low, closed=(False, False))
    return pin_picture(plotter, lambda height, width: bar_picture((low, high), title, height, width), "right")


def bar_picture(
    clim: tuple[float, float],
    title: str,
    height: int,
    width: int,
) -> Array:  # [h, w, 3] uint8
    """A colour bar from `clim[0]` (below) to `clim[1]`, with round numbers and a title, for a subplot of this size."""
    from matplotlib import colormaps

    size = min(letter_size(height), max(SMALLEST, height // 16))
    font, gap, line = ImageFont.load_default(size=size), size // 2, round(size * 1.5)
    heading = _broken(title, font, max(width / 5, 8 * size))
    ticks = round_numbers(*clim)
    length = max(int(BAR * height) - line * len(heading), 4 * line)
    texts = [*heading, *(" " * 8 + f"{tick:g}" for tick in ticks)]
    across = 2 * gap + max(round(font.getlength(text)) for text in texts)
    paper = Image.new("RGB", (max(across, 4 * size), length + line * len(heading) + 2 * gap + size), LEGEND_PAPER)
    draw = ImageDraw.Draw(paper)
    for row, text in enumerate(heading):
        draw.text((gap, gap + row * line), text, fill=LEGEND_INK, font=font)
    top, right = gap + len(heading) * line + size // 2, gap + round(1.4 * size)
    colors = colormaps[COLORMAP](np.linspace(1, 0, length), bytes=True)[:, None, :3]
    paper.paste(Image.fromarray(np.repeat(colors, right - gap, axis=1)), (gap, top))
    for tick in ticks:
        y = top + (clim[1] - tick) / (clim[1] - clim[0]) * (length - 1)
        draw.line((right, y, right + size // 4, y), fill=LEGEND_INK)
        draw.text((right + gap, y), f"{tick:g}", fill=LEGEND_INK, font=font, anchor="lm")
    return np.asarray(paper)


def round_numbers(low: float, high: float) -> list[float]:
    """From three to six evenly spaced round numbers from `low` to `high`, ascending."""
    from matplotlib.ticker import MaxNLocator

    slack = 1e-9 * (high - low)
    ticks = MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10], min_n_ticks=3).tick_values(low, high)
    return [float(tick) + 0.0 for tick in ticks if low - slack <= tick <= high + slack]


def letter_size(height: int) -> int:
    """Size of letters, in pixels, for a subplot of this height."""
    return max(LETTERS, round(height / 55))


def letters(plotter: pv.Plotter) -> tuple[float, float, float]:
    """A text colour that can be read on the active subplot's background."""
    dark = np.mean(plotter.renderer.GetBackground()) < DARK
    ink = (255, 255, 255) if dark else LEGEND_INK
    return (ink[0] / 255, ink[1] / 255, ink[2] / 255)


def _broken(text: str, font: Any, width: float) -> list[str]:
    """Break text into lines of at most `width` pixels; a longer word has a line of its own."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def pin_picture(
    plotter: pv.Plotter,
    draw: Callable[[int, int], Array],  # (height, width) of the subplot, pixels -> [h, w, 3] uint8
    corner: Literal["left", "right"] = "left",
) -> Any:
    """Put a picture into a lower corner of the active subplot; it appears in the next frame.

    Args:
        plotter: where to draw.
        draw: makes the picture; called again when the subplot's size changes. Leave a margin of 10 pixels on each side.
        corner: which lower corner.

    Returns:
        The actor; `plotter.remove_actor` removes it.
    """
    actor = picture_actor()
    pinned = _Pinned(plotter.renderer, actor, draw, corner)
    pinned.draw(*_size_of(plotter))
    plotter.add_actor(actor, reset_camera=False, pickable=False, render=False)
    pinned.tag = plotter.renderer.AddObserver("StartEvent", pinned.before_frame)
    return actor


class _Pinned:
    """Redraws a picture when the size of its subplot changes, until its actor is removed."""

    def __init__(self, renderer: Any, actor: Any, make: Callable[[int, int], Array], corner: str) -> None:
        self.renderer, self.actor, self.make, self.corner = renderer, actor, make, corner
        self.size: tuple[int, int] | None = None
        self.tag = 0

    def before_frame(self, *_: Any) -> None:
        if not self.renderer.HasViewProp(self.actor):
            self.renderer.RemoveObserver(self.tag)
            return
        width, height = self.renderer.GetSize()
        self.draw(height, width)

    def draw(self, height: int, width: int) -> None:
        if self.size == (height, width):
            return
        self.size = (height, width)
        picture = self.make(height, width)
        set_picture(self.actor, picture)
        left = MARGIN if self.corner == "left" else max(width - picture.shape[1] - MARGIN, 0)
        self.actor.SetPosition(left, MARGIN)


def picture_actor() -> Any:
    """A flat VTK actor that shows a picture pixel by pixel; `set_picture` gives it one."""
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    mapper = vtkImageMapper()
    mapper.SetColorWindow(255)  # bytes stay as they are
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    return actor


def set_picture(actor: Any, picture: Array) -> None:  # [H, W, 3] uint8
    """Exchange the picture of a `picture_actor`."""
    import pyvista as pv

    height, width, _ = picture.shape
    image = pv.ImageData(dimensions=(width, height, 1))
    image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
    image.set_active_scalars("rgb")
    actor.GetMapper().SetInputData(image)


def _size_of(plotter: pv.Plotter) -> tuple[int, int]:
    """(height, width) of the active subplot, known before the first frame."""
    width, height = plotter.window_size
    x0, y0, x1, y1 = plotter.renderer.GetViewport()
    return max(round((y1 - y0) * height), 1), max(round((x1 - x0) * width), 1)
