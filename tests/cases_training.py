"""Small trainings: options with changes in any of their parts, Gaussians, cameras, and whether two clouds are equal."""

from dataclasses import fields, replace

import torch

from kfgs import Camera, Gaussians, rasterize
from kfgs.fields import Densify, Rates, Training

DENSIFY = {field.name for field in fields(Densify)}
RATES = {field.name for field in fields(Rates)}


def changed(training: Training, **changes) -> Training:
    """Names are those of `Training`, `Rates` (with `_rate`: `scales_rate=0.01`) and `Densify`."""
    rates = {name: changes.pop(f"{name}_rate") for name in RATES if f"{name}_rate" in changes}
    densify = {name: changes.pop(name) for name in DENSIFY if name in changes}
    if densify:
        changes["densify"] = replace(training.densify, **densify)
    return replace(training, rates=replace(training.rates, **rates), **changes)


SHORT = changed(
    Training(),
    steps=60,
    extent=2.0,
    scales_rate=0.01,
    means_rate=1e-3,
    means_final_rate=1e-4,
    start=5,
    stop=45,
    every=10,
    gradient=5e-4,
    report_every=10,
    checkpoint_every=20,
)


def blobs(n=12, seed=0, *, colors=False) -> Gaussians:
    """Gaussians around the origin with 3 features, or with colours of degree 1."""
    g = torch.Generator().manual_seed(seed)
    shape = {
        "means": torch.rand(n, 3, generator=g) * 2 - 1,
        "quats": torch.randn(n, 4, generator=g),
        "scales": torch.rand(n, 3, generator=g) * 0.25 + 0.1,
        "opacities": torch.rand(n, generator=g) * 0.6 + 0.3,
    }
    if colors:
        return Gaussians(**shape, sh=torch.randn(n, 4, 3, generator=g) * 0.4)
    return Gaussians(**shape, features=torch.rand(n, 3, generator=g))


def scene(views=5, truth=None):
    """Cameras around the origin and what they see of some Gaussians."""
    cameras = [look_at_origin(0.5 * i) for i in range(views)]
    truth = blobs() if truth is None else truth
    return cameras, [rasterize(truth, camera).map.clamp(0, 1) for camera in cameras]


def look_at_origin(angle: float) -> Camera:
    """A camera of 24 x 32 pixels on a circle of radius 4 around the y axis, looking at the origin."""
    c, s = torch.cos(torch.tensor(angle)), torch.sin(torch.tensor(angle))
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    viewmat[2, 3] = 4.0
    return Camera(viewmat, torch.tensor([[30.0, 0, 16.3], [0, 31.0, 11.6], [0, 0, 1]]), 32, 24, name=f"view {angle}")


def same(a: Gaussians, b: Gaussians) -> bool:
    """Whether all tensors are equal."""
    first, second = a.tensors(), b.tensors()
    return list(first) == list(second) and all(torch.equal(first[name], second[name]) for name in first)
