"""Find earlier uplifts of a scene that had fewer views, so that new views are added to one instead of fusing all again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .._arrays import read_safetensors
from .._files import digest_value, read_json
from ..cameras import Camera
from ..fields import UpliftSums
from .maps import Maps, ViewMaps
from .stages import STAGE_FILE, Run, digest_tensors, is_whole, origin_tensors

SUMS = "sums.safetensors"
GROWTH = 2
"""When there are this many times the views that were fused at once, all are fused again. Latents are then chosen for all, and
all fits of a growing scene together cost at most about three times the last full one."""


@dataclass(frozen=True)
class Earlier:
    """A finished uplift of some of a run's views."""

    key: str
    folder: Path
    views: list[int]
    """Its views, as positions among those of the run."""
    first: int
    """How many views were fused at once, before others were added."""
    geometry: str
    """Digest of the Gaussians."""

    @property
    def sums(self) -> UpliftSums:
        """What it kept."""
        return UpliftSums.from_tensors(read_safetensors(self.folder / SUMS)[0])


def find_earlier(run: Run, inputs: dict[str, Any], cameras: Sequence[Camera], maps: Maps) -> list[Earlier]:
    """Uplifts in the run folder with the same options, and some of the same views: equal maps, lenses, masks and poses.

    Args:
        run: the run folder.
        inputs: `features`, `config`, `seed` and `latents` of the uplift of all views.
        cameras: all views.
        maps: their maps.

    Returns:
        That with the most views first. Those that kept no sums are left out, and so are those whose first fit had fewer than
        1 / `GROWTH` of all views.
    """
    wanted = json.loads(json.dumps({name: inputs.get(name) for name in ("config", "seed", "latents")}))

    def look() -> list[dict[str, Any]]:
        found = []
        for about in sorted((run.folder / "stages").glob(f"uplift-*/{STAGE_FILE}")):
            if not (about.with_name(SUMS).is_file() and is_whole(about.parent)):
                continue
            inputs_then, facts = read_json(about)["inputs"], read_json(about.with_name("facts.json"))
            views = _positions(inputs_then["features"]["files"], inputs["features"]["files"])
            if (
                {name: inputs_then.get(name) for name in wanted} == wanted
                and views is not None
                and len(views) < len(cameras) <= GROWTH * facts["first"]
                and inputs_then["features"]["lenses"] == digest_changes(maps, views)
                and inputs_then["cameras"] == _digest_then(cameras, views, facts["near"])
            ):
                key = about.parent.name.removeprefix("uplift-")
                found.append({"key": key, "views": views, "first": facts["first"], "geometry": inputs_then["geometry"]})
        return sorted(found, key=lambda one: -len(one["views"]))

    return [Earlier(folder=run.folder / "stages" / f"uplift-{one['key']}", **one) for one in look()]


def digest_cameras(cameras: Sequence[Camera]) -> str:
    """SHA-256 of poses, intrinsics, sizes and near planes."""
    rows = [tensor for camera in cameras for tensor in (camera.viewmat, camera.K)]
    facts = torch.tensor([[camera.width, camera.height, camera.near] for camera in cameras], dtype=torch.float64)
    return digest_tensors(*rows, facts, *(origin_tensors(cameras[0].origin) if cameras else ()))


def digest_changes(maps: Maps, views: Sequence[int] | None = None) -> str | None:
    """SHA-256 of the lenses and masks that change the maps of some views (None: all); None if there are none."""
    if not isinstance(maps, ViewMaps):
        return None
    changes = [maps.describe(i) for i in (range(len(maps)) if views is None else views)]
    return digest_value(changes) if any(change is not None for change in changes) else None


def _positions(then: list[list[str]], now: list[list[str]]) -> list[int] | None:
    """Where the earlier maps are among those of now; None if one is missing."""
    places: dict[tuple[str, ...], list[int]] = {}
    for i, one in reversed([*enumerate(now)]):
        places.setdefault(tuple(one), []).append(i)
    try:
        return [places[tuple(one)].pop() for one in then]
    except (KeyError, IndexError):
        return None


def _digest_then(cameras: Sequence[Camera], views: Sequence[int], near: Sequence[float]) -> str:
    """The digest of some cameras with the near planes of then: more views change the scene's extent, and near follows it."""
    return digest_cameras([replace(cameras[i], near=one) for i, one in zip(views, near, strict=True)])
