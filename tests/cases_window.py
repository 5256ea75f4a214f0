"""An explorer of two small clouds, drawn off-screen, and what kfgs's own rasteriser makes of its sides."""

import math

import torch
from cases_viz import some_camera, some_gaussians

from kfgs.splat.rasterize import rasterize
from kfgs.viewer import ExploreOptions, Explorer
from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration

NAMES = ("wall", "chair", "table", "sofa", "lamp")
TITLE, LEGEND = 30, 120  # pixels that a title and a legend cover
SMALL = {"height": 240, "width": 640}


def a_state(sides=2, **options):
    semantic, color = some_gaussians(), some_gaussians(90, seed=1)
    semantic = semantic.replace(sh=None)
    color = color.replace(features=None, labels=None)
    scores = torch.linspace(0.2, 1, len(semantic)).numpy()
    meaning = SplatMeaning(semantic.replace(scores=scores, names=NAMES))
    return Exploration(meaning, color if sides == 2 else None, **options)


def an_explorer(state=None, **options):
    camera = options.pop("camera", some_camera().resized(240, 320))
    return Explorer(state or a_state(), ExploreOptions(**(SMALL | options)), camera=camera, off_screen=True)


def expected(state, side, rest=1.0):
    """What kfgs's own rasteriser makes of a side, on white."""
    cloud = state.cloud(side)
    opacities = cloud.opacities.clone()
    if state.asked is not None:
        opacities[torch.from_numpy(~state.selected(side))] *= rest
    opacities[torch.from_numpy(~state.drawn(side))] = 0
    colors = torch.from_numpy(state.colors(side) / 255).float()
    cloud = cloud.replace(features=colors, sh=None, labels=None, opacities=opacities)
    cloud = cloud.select(opacities > 0)
    seen = rasterize(cloud, some_camera().resized(240, 320).to(torch.float32))
    return (seen.map + (1 - seen.alpha)[..., None]).numpy()


def psnr(seen, other):
    return -10 * math.log10(((seen - other) ** 2).mean())


def panes(picture):
    return {"semantic": picture[:, :319], "color": picture[:, 321:]}  # a line lies between them


def agreement(explorer, side, rest=1.0):
    seen = panes(explorer.screenshot() / 255)[side]
    other = expected(explorer.state, side, rest)
    other = other[:, :319] if side == "semantic" else other[:, 1:]
    return psnr(seen[TITLE:, LEGEND:300], other[TITLE:, LEGEND:300])
