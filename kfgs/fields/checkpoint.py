"""The state of an unfinished fit in one file, so that a killed run can continue (on a CPU with bit-equal results)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import read_safetensors
from .._card import short_repr
from .._check import as_tensor
from .._files import atomic_path, digest_value, parse_json
from .._tensors import save_tensors
from ..cameras import Camera
from .config import FieldConfig
from .params import GaussianParams

KIND, VERSION = "field checkpoint", "1"


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a fit needs to continue: numbers in `state`, tensors by name."""

    tensors: dict[str, Tensor]
    state: dict[str, Any]

    __repr__ = short_repr


def identify_fit(
    params: GaussianParams,
    cameras: Sequence[Camera],
    targets: Sequence[Tensor],
    config: FieldConfig,
    *,
    generator: torch.Generator,
    others: dict[str, Any],
) -> dict[str, str]:
    """A digest of each input of a fit. Of the targets, only their number and the first map count.

    The extent of the config may be None, so the caller puts the one in use into `others`.
    """
    options = {name: value for name, value in config.identity().items() if name not in ("checkpoint_every", "extent")}
    views = [tensor for camera in cameras for tensor in (camera.viewmat, camera.K, torch.tensor(camera.size))]
    views.append(torch.tensor([camera.near for camera in cameras], dtype=torch.float64))
    return {
        "params": digest_tensors([*params.to_tensors().values(), torch.tensor(params.antialiased)]),
        "cameras": digest_tensors(views),
        "targets": digest_tensors([torch.tensor(len(targets)), as_tensor("targets[0]", targets[0], floating=True)]),
        "config": digest_value(options),
        "generator": digest_tensors([generator.get_state()]),
        **{name: digest_value(value) for name, value in others.items()},
    }


def write_checkpoint(path: Path, checkpoint: Checkpoint, identity: dict[str, str]) -> None:
    """Write the file; it is whole or absent.

    Raises:
        FileNotFoundError: if its folder is missing. `fit_field` makes it at the start: a folder that is made again would hide
            until the end of the training that something else deleted it.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"{path.parent}: expected this folder to stay while Gaussians are trained, but something else deleted or moved "
            "it; start again"
        )
    metadata = {
        "kfgs": KIND,
        "version": VERSION,
        "identity": json.dumps(identity),
        "state": json.dumps(checkpoint.state, allow_nan=False),
    }
    with atomic_path(path) as temporary:
        save_tensors(temporary, checkpoint.tensors, metadata)


def read_checkpoint(path: Path, identity: dict[str, str]) -> Checkpoint | None:
    """Read the file, or None if there is none.

    Raises:
        ValueError: if the file is damaged or no checkpoint, or belongs to a fit with other inputs.
    """
    if not path.exists():
        return None
    advice = "delete it to start again, or give another path"
    tensors, metadata = read_safetensors(path, f"a kfgs {KIND}", advice, kfgs=(KIND, VERSION))
    try:
        known, state = (dict(parse_json(metadata[key])) for key in ("identity", "state"))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a kfgs {KIND}, but it cannot be read ({error}); {advice}") from error
    differing = sorted(name for name in identity | known if identity.get(name) != known.get(name))
    if differing:
        raise ValueError(
            f"checkpoint: expected one of this very fit at {path}, got one with other {', '.join(differing)}; {advice}"
        )
    return Checkpoint(tensors, state)


def digest_tensors(tensors: Iterable[Tensor]) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
