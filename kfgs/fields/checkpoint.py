"""The state of an unfinished fit in one file, so that a killed run can continue (on a CPU with bit-equal results)."""

from __future__ import annotations

import hashlib
import io
import pickle
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._check import as_tensor
from .._files import atomic_path, digest_value
from ..cameras import Camera
from .loss import Loss
from .params import GaussianParams
from .training import Training


def digest_tensors(*tensors: Tensor) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def identify_fit(
    params: GaussianParams,
    cameras: Sequence[Camera],
    targets: Sequence[Tensor],
    training: Training,
    loss: Loss,
    generator: torch.Generator,
) -> dict[str, str]:
    """A digest of each input of a fit. Of the targets, only their number and the first map count."""
    views = [tensor for camera in cameras for tensor in (camera.viewmat, camera.K)]
    facts = [(camera.size, camera.near) for camera in cameras]
    options = {name: value for name, value in asdict(training).items() if name != "checkpoint_every"}
    return {
        "params": digest_tensors(*params.to_tensors().values()) + digest_value([params.origin, params.antialiased]),
        "cameras": digest_tensors(*views) + digest_value(facts),
        "targets": digest_tensors(as_tensor("targets[0]", targets[0], floating=True)) + str(len(targets)),
        "training": digest_value(options),
        "generator": digest_tensors(generator.get_state()),
        "loss": getattr(loss, "__qualname__", None) or repr(loss),
    }


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write the file; it is whole or absent. Its folder was made at the start and is not made again."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: expected this folder to stay while Gaussians are trained; start again")
    buffer = io.BytesIO()  # torch.save reports a full disk as a bug of its own, with a traceback
    torch.save(state, buffer)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_checkpoint(path: Path, identity: dict[str, str]) -> dict[str, Any]:
    """Read the file; a ValueError if it is damaged, or belongs to a fit with other inputs."""
    advice = "delete it to start again, or give another path"
    try:
        with path.open("rb") as file:
            state = torch.load(file, map_location="cpu", weights_only=True)
        known = dict(state["identity"])
    except (
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        RuntimeError,
        LookupError,
        TypeError,
        ValueError,
        EOFError,
    ) as error:
        raise ValueError(f"{path}: expected a checkpoint of kfgs, got another or a damaged file; {advice}") from error
    differing = sorted(name for name in identity | known if identity.get(name) != known.get(name))
    if differing:
        raise ValueError(
            f"checkpoint: expected one of this very fit at {path}, got one with other {', '.join(differing)}; {advice}"
        )
    return dict(state)
