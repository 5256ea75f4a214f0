"""What every baseline is given and what it returns, and a few small tools."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.quant.maps import FeatureMaps
from kfgs.splat.views import sum_pixels

from .methods import RenderedMethod

FLOAT = 4  # bytes
KEPT = 2**30  # bytes of maps that are kept in memory once they were read


@dataclass(frozen=True)
class Task:
    """A scene to learn: one frozen cloud, and a teacher map for each posed view."""

    geometry: Gaussians
    cameras: Sequence[Camera]
    maps: FeatureMaps
    """One map [h, w, D] per camera; an all-zero feature says nothing about its pixel."""
    seed: int = 0
    progress: bool = False

    def generator(self) -> torch.Generator:
        """The random numbers of a fit."""
        return torch.Generator().manual_seed(self.seed)

    @property
    def frozen(self) -> Gaussians:
        """The geometry without features, colours and gradient."""
        return self.geometry.replace(features=None, sh=None, labels=None).detach()


@dataclass(frozen=True, eq=False)
class Fitted:
    """A finished baseline."""

    method: RenderedMethod
    dim: str
    """Numbers of a Gaussian, as the table prints them."""
    storage: int
    """Bytes as the paper's Table 1 counts them: float32 of what the semantics add, with what decodes them."""
    tensors: dict[str, Tensor]
    """All that has to be kept beside the geometry."""
    seconds: dict[str, float]
    """Time of each stage."""
    history: list[dict[str, Any]] = field(default_factory=list)
    codec: Callable[[Tensor], Tensor] | None = None
    """What compression alone makes of the teacher's features, [n, D] -> [n, D], without Gaussians; None if there is none."""
    own_geometry: bool = False
    """Whether the method has Gaussians of its own, so that those of the colours are not needed."""


class Clock:
    """Seconds of named stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


class KeptMaps:
    """Maps that are read once and then kept, if all of them take less than 1 GB."""

    def __init__(self, maps: FeatureMaps) -> None:
        self._maps = maps
        self._kept: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, i: int) -> Tensor:  # [h, w, D]
        if i in self._kept:
            return self._kept[i]
        value = self._maps[i].float()
        if value.numel() * FLOAT * len(self) <= KEPT:
            self._kept[i] = value
        return value


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Initial weights of torch's layers from a seed; the state of torch's generator is as before afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def within(camera: Camera, pixels: int | None) -> Camera:
    """The camera at the largest size of its shape with at most `pixels` pixels; None changes nothing."""
    if pixels is None or camera.width * camera.height <= pixels:
        return camera
    scale = (pixels / (camera.width * camera.height)) ** 0.5
    return camera.resized(max(1, int(camera.height * scale)), max(1, int(camera.width * scale)))


def sample_rows(maps: FeatureMaps, count: int, generator: torch.Generator) -> Tensor:  # [n, D]
    """Known features of all maps, at most `count`, equally many of each map."""
    each, parts = -(-count // len(maps)), []
    for i in range(len(maps)):
        rows = maps[i].flatten(0, 1)
        rows = rows[rows.any(dim=1)]
        parts.append(rows[torch.randperm(len(rows), generator=generator)[:each]])
    return torch.cat(parts)


def is_shown(geometry: Gaussians, cameras: Sequence[Camera], pixels: int | None = 80_000) -> Tensor:  # [N] bool
    """Which Gaussians fill some part of some view: the others have learnt nothing."""
    weights = torch.zeros_like(geometry.opacities)
    for camera in cameras:
        small = within(camera, pixels)
        index, _, weight = sum_pixels(geometry, small, torch.ones(small.height, small.width, 1))
        weights.index_add_(0, index, weight)
    return weights > 0
