"""An explorer's window without a display, and the keys and the mouse that are used on it."""

from contextlib import contextmanager

import numpy as np
import torch
from cases_explorer import NAMES, cloud, splat_file

from kfgs.viz.explorer import ExploreOptions, Explorer
from kfgs.viz.explorer.desktop import Desktop
from kfgs.viz.explorer.meaning import SplatMeaning
from kfgs.viz.explorer.panel import WIDTH
from kfgs.viz.explorer.state import Exploration

HEIGHT, CLOUDS = 420, 600  # pixels: of the window, and what the two clouds have of its width
CHAIR = NAMES.index("chair")


def clouds():
    """Four classes in the corners of a square; the colour cloud the same, 0.1 aside."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(80) % 4
    corners = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 0]])
    means = corners[labels] + 0.2 * torch.randn(80, 3, generator=generator)
    semantic = cloud(means, labels, scales=torch.full((80, 3), 0.15))
    color = cloud(means + torch.tensor([0.1, 0, 0]), sh=torch.rand(80, 1, 3, generator=generator) - 0.5)
    return semantic, color.replace(scales=torch.full((80, 3), 0.15))


@contextmanager
def opened(out):
    semantic, color = clouds()
    state = Exploration(SplatMeaning(splat_file(semantic, np.linspace(0.1, 0.9, 80, dtype=np.float32))), color)
    options = ExploreOptions(height=HEIGHT, width=CLOUDS, style="points", out=out)
    with Explorer(state, options, off_screen=True) as explorer:
        window = Desktop(explorer)
        explorer.plotter.show(interactive=False, auto_close=False)
        yield window


def press(desktop, *keys):
    """Keys by their X names, as VTK's interactor sends them: first the key, then the character."""
    interactor = desktop.explorer.plotter.iren.interactor
    codes = {"slash": "/", "Return": "\r", "Escape": "\x1b", "BackSpace": "\b", "Tab": "\t", "space": " "}
    for key in keys:
        interactor.SetKeyEventInformation(0, 0, codes.get(key, key if len(key) == 1 else "\0"), 0, key)
        interactor.InvokeEvent("KeyPressEvent")
        interactor.InvokeEvent("CharEvent")


def spot(desktop, kind, value=None):
    return next(one for one in desktop.pane.panel.spots if (one.kind, one.value) == (kind, value))


def place(desktop, kind, value=None, share=0.5):
    """Window pixels, y from below, of something in the panel."""
    left, top, right, bottom = spot(desktop, kind, value).box
    width, height = desktop.explorer.plotter.window_size
    x = left + round(share * (right - 1 - left))
    return width - WIDTH + x, height - 1 - (top + bottom) // 2


def click(desktop, kind, value=None):
    desktop.explorer.plotter.iren._mouse_left_button_click(*place(desktop, kind, value))


def shot(desktop):
    return desktop.explorer.screenshot().astype(np.int64)


def changed(before, after):
    """Whether the clouds' side of the window and the panel's differ."""
    differs = (before != after).any(-1)
    return bool(differs[:, :CLOUDS].any()), bool(differs[:, CLOUDS:].any())


def drag(desktop, name, shares):
    mouse = desktop.explorer.plotter.iren
    mouse._mouse_left_button_press(*place(desktop, "slider", name, shares[0]))
    for share in shares[1:]:
        mouse._mouse_move(*place(desktop, "slider", name, share))
    mouse._mouse_left_button_release()


def seen(desktop, index):
    """Window pixels, y from below, of a semantic Gaussian."""
    renderer = desktop.explorer.plotter.renderers[0]
    x, y, z = desktop.explorer.state.cloud("semantic").means[index].tolist()
    renderer.SetWorldPoint(x, y, z, 1.0)
    renderer.WorldToDisplay()
    return tuple(round(v) for v in renderer.GetDisplayPoint()[:2])
