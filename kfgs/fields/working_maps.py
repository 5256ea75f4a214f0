"""Feature maps at a working size: blocks of pixels averaged, in a few directions, stored in files during fusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._check import check_shapes
from .._files import atomic_path
from .._rows import ENCODE, EPS, check_directions, row_norms, unit_rows
from ..cameras import Camera
from ..cameras.resample import check_layout, from_bchw, to_bchw
from ..quant.linear import LinearLatents, principal_directions
from ..quant.maps import FeatureMaps, all_zero, read_blocks, read_grid

WORKING = 64
"""Number of working directions. For room_0's maps they keep 98.8 % of the energy; the rest is noise of single pixels. The
latents found in them keep a cosine above 0.99 with the average of all 512 channels."""
LOOKED_AT = 32, 2_000  # the working directions are found in so many views, and so many features of each


def shrink_map(map: Tensor, divisor: int) -> Tensor:  # [H, W, D] -> [H // divisor, W // divisor, D]
    """The mean of each block of divisor x divisor pixels; NaN if one is NaN. Incomplete blocks at the ends are dropped."""
    return from_bchw(torch.nn.functional.avg_pool2d(to_bchw(map), divisor))


def shrink_camera(camera: Camera, divisor: int) -> Camera:
    """The camera of a picture shrunk by `shrink_map`: its pixels are exactly `divisor` times as wide.

    `Camera.resized` would include the dropped pixels, and move everything by a fraction of a pixel.
    """
    factors = camera.K.new_tensor([1 / divisor, 1 / divisor, 1.0])[:, None]
    return replace(camera, K=camera.K * factors, width=camera.width // divisor, height=camera.height // divisor)


class WorkingView(NamedTuple):
    """A view at its working size."""

    camera: Camera
    map: Tensor  # [h, w, d], NaN where nothing is known
    factor: int  # from the map's size to the camera's
    scale: float  # original pixels that a pixel of the camera covers


class WorkingMaps:
    """The maps at their working size, in few directions, each in a file."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        maps: FeatureMaps,
        directions: Tensor,  # [D, d']
        pixels: int,
        folder: Path,
    ) -> None:
        self._cameras, self._maps, self._pixels, self._folder = cameras, maps, pixels, folder
        self.directions = directions
        self.basis: Tensor | None = None
        """[d', d]: from now on return maps in these directions, given in the working directions."""

    def __len__(self) -> int:
        return len(self._cameras)

    def __getitem__(self, i: int) -> WorkingView:
        file = self._folder / f"{i}.npz"
        if not file.is_file():
            made, size = self._make(i)
            with atomic_path(file) as path, path.open("wb") as opened:
                # not rounded, so that a run that continues gives the same bits
                np.savez(opened, rows=made.cpu().numpy(), shape=np.asarray(size))
        with np.load(file) as arrays:
            rows, shape = torch.from_numpy(arrays["rows"]).to(self.directions), torch.from_numpy(arrays["shape"])
        (h, w, _), camera = rows.shape, self._cameras[i]
        factor = max(1, min(camera.height // h, camera.width // w, int((self._pixels / (h * w)) ** 0.5)))
        features = rows if self.basis is None else rows @ self.basis
        # the whole picture in working pixels: not a whole number if some at the right or bottom were left over
        whole = factor * shape.double().flip(0) / self._shrinkage(*shape.tolist())
        span = whole / torch.tensor([camera.width, camera.height])
        K = camera.K.to(features) * torch.cat([span, torch.ones(1)]).to(features)[:, None]
        working = replace(camera.to(features), K=K, width=w * factor, height=h * factor)
        return WorkingView(working, features, factor, 1 / float(span.prod()))

    def _make(self, i: int) -> tuple[Tensor, tuple[int, int]]:  # [h, w, d'], and the map's own (height, width)
        """Read a map as unit features in the working directions, and shrink it to its working size."""
        parts, masks = [], []
        for block in read_blocks(self._maps, i):  # [r, w, D]
            check_shapes((f"maps[{i}]", block, ("h", "w", len(self.directions))))
            features = block.to(self.directions)
            lengths = row_norms(features)
            check_directions(f"maps[{i}]", features, lengths, ENCODE)
            masks.append((lengths > EPS)[..., None])
            parts.append((features @ self.directions) / lengths.clamp_min(EPS)[..., None] * masks[-1])
        rows, known = torch.cat(parts), torch.cat(masks)
        height, width = rows.shape[:2]
        check_layout(f"maps[{i}]", (height, width, len(self.directions)), self._cameras[i].size)
        if (shrink := self._shrinkage(height, width)) > 1:
            rows, share = shrink_map(rows, shrink), shrink_map(known.to(rows), shrink)
            rows, known = rows / share.clamp_min(EPS), share > 0.5
        return torch.where(known, rows, torch.nan).contiguous(), (height, width)

    def _shrinkage(self, height: int, width: int) -> int:
        """By which whole number a map is shrunk to have at most so many pixels."""
        least = min(height, width)
        return next((n for n in range(1, least) if (height // n) * (width // n) <= self._pixels), least)


def sample_latents(maps: FeatureMaps, count: int = WORKING, most: int = LOOKED_AT[0]) -> LinearLatents:
    """The main `count` directions of unit features, from samples of at most `most` evenly spread maps.

    With the latents of maps from several scenes, or from all parts of one, the fields of these agree.
    """
    moment: Tensor | None = None
    for i in sorted({round(i) for i in np.linspace(0, len(maps) - 1, min(most, len(maps)))}):
        rows = read_grid(maps, i, LOOKED_AT[1]).float()
        check_shapes((f"maps[{i}]", rows, ("n", "D" if moment is None else len(moment))))
        check_directions(f"maps[{i}]", rows, advice=ENCODE)
        rows = unit_rows(rows) * (row_norms(rows) > EPS)[:, None]
        moment = rows.T @ rows if moment is None else moment + rows.T @ rows
    if moment is None or not bool(moment.any()):
        raise all_zero(len(maps))
    return LinearLatents(principal_directions(moment)[1][:, :count].float())
