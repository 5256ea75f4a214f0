"""An explorer's window without a display, and the keys and the mouse that are used on it."""

from contextlib import contextmanager

import numpy as np
import torch
from cases_explorer import cloud, splat_file
from kfgs.viewer.desktop import Desktop

from kfgs.viewer import ExploreOptions, Explorer
from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration

HEIGHT, WIDTH = 420, 600  # pixels


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
    options = ExploreOptions(height=HEIGHT, width=WIDTH, style="points", out=out)
    with Explorer(state, options, off_screen=True) as explorer:
        window = Desktop(explorer)
        explorer.plotter.show(interactive=False, auto_close=False)
        yield window


def press(desktop, *keys):
    """Keys by their X names, as VTK's interactor sends them: first the key, then the character."""
    interactor = desktop.plotter.iren.interactor
    for key in keys:
        interactor.SetKeyEventInformation(0, 0, key if len(key) == 1 else "\0", 0, key)
        interactor.InvokeEvent("KeyPressEvent")
        interactor.InvokeEvent("CharEvent")


def drag(desktop, name, share):
    """The slider's handle to a share of its length."""
    slider, mouse = desktop.sliders[name].GetRepresentation(), desktop.plotter.iren
    low, high = slider.GetMinimumValue(), slider.GetMaximumValue()
    (left, y), (right, _) = (
        end.GetComputedDisplayValue(desktop.plotter.renderers[0])
        for end in (slider.GetPoint1Coordinate(), slider.GetPoint2Coordinate())
    )
    place = lambda value: round(left + (right - left) * (value - low) / (high - low))  # noqa: E731
    mouse._mouse_left_button_press(min(max(place(slider.GetValue()), left + 3), right - 3), y)  # beside the ends' caps
    mouse._mouse_move(place(low + share * (high - low)), y)
    mouse._mouse_left_button_release()


def shot(desktop):
    return desktop.explorer.screenshot().astype(np.int64)


def seen(desktop, index):
    """Window pixels, y from below, of a semantic Gaussian."""
    renderer = desktop.plotter.renderers[0]
    x, y, z = desktop.explorer.state.cloud("semantic").means[index].tolist()
    renderer.SetWorldPoint(x, y, z, 1.0)
    renderer.WorldToDisplay()
    return tuple(round(v) for v in renderer.GetDisplayPoint()[:2])
