"""The `color.ply` of a run folder: it is replaced only if it is what a colour stage of the run wrote, byte for byte."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from safetensors import SafetensorError

from .._files import digest_file, hidden_folder
from .._origin import to_world
from ..formats import read_splats, write_splats
from ..gaussians import Gaussians
from .stages import Run
from .train import PARAMS, stage_params


def may_replace(run: Run, path: Path) -> bool:
    """Whether nothing is at `path`, or the bytes that one of the run's colour stages writes there."""
    if not os.path.lexists(path):
        return True
    if not path.is_file():  # a folder, or a link to nothing
        return False
    found = digest_file(path)
    with hidden_folder(run.folder) as place:
        for params in sorted((run.folder / "stages").glob(f"color-*/{PARAMS}")):
            written = place / path.name
            try:
                write_splats(written, stage_gaussians(params.parent))
            except (OSError, ValueError, KeyError, SafetensorError):  # a damaged stage wrote nothing that is known
                continue
            if digest_file(written) == found:
                return True
    return False


def what_is(path: Path) -> str:
    """What stands at `path` instead, as the end of a sentence."""
    if path.is_symlink() and not path.exists():
        return "is a link to a file that does not exist"
    try:
        read_splats(path)
    except (OSError, ValueError):
        return "is another file"
    return "holds other Gaussians"


def stage_gaussians(folder: Path) -> Gaussians:
    """The Gaussians of a finished colour stage."""
    return stage_params(folder).activated().detach()


def is_saved(path: Path, ours: Gaussians) -> bool:
    """Whether the file has this cloud already; then it is not written again, because it may have labels now."""
    try:
        saved = read_splats(path).gaussians
    except (OSError, ValueError):
        return False
    if saved.sh is None or len(saved) != len(ours):
        return False
    same = all(torch.equal(getattr(saved, name), getattr(ours, name)) for name in ("quats", "sh"))
    places, wanted = (to_world(cloud.means, cloud.origin) for cloud in (saved, ours))
    same &= torch.allclose(places, wanted, rtol=1e-12) if any(ours.origin) else torch.equal(places, wanted)
    return same and all(torch.allclose(getattr(saved, name), getattr(ours, name)) for name in ("scales", "opacities"))
