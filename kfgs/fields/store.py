"""A semantic field on disk: one folder with `field.safetensors` (numbers) and `field.json` (their description)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from .._files import atomic_folder, digest_file, read_json, write_json
from ..cameras import Camera
from ..gaussians import Gaussians
from ..quant import Autoencoder, Codebook, LinearLatents
from .answers import Seen
from .remembered import rebased

FORMAT, VERSIONS = "kfgs.semantic_field", (1, 2)
"""Version 2 may hold linear latents, fused answers and cameras."""
TENSORS, DESCRIPTION = "field.safetensors", "field.json"


def save_field(path: str | Path, parts: Mapping[str, Any]) -> None:
    """Write the parts of a field, as returned by `load_field`, into a folder; see `SemanticField.save`."""
    path = Path(path)
    if path.exists() and not (path / DESCRIPTION).is_file() and not (path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(
            f"path: expected a new folder or an older field at {path}, got something else; give another"
        )
    gaussians, cameras = parts["gaussians"], parts["cameras"]
    info = rebased(parts["info"], parts["folder"], path)
    try:
        json.dumps(info, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"info: expected what JSON can hold, got {error}; use strings and finite numbers") from error
    tensors = {f"gaussians.{name}": value for name, value in vars(gaussians).items() if value is not None}
    for part in ("codebook", "autoencoder", "linear"):
        if parts[part] is not None:
            tensors |= {f"{part}.{name}": value for name, value in parts[part].to_tensors().items()}
    if parts["answers"] is not None:
        tensors["answers.latents"] = parts["answers"]
    if parts["seen"] is not None:
        tensors |= {f"seen.{name}": value for name, value in parts["seen"]._asdict().items()}
    if cameras:
        tensors["cameras.viewmats"] = torch.stack([camera.viewmat for camera in cameras])
        tensors["cameras.Ks"] = torch.stack([camera.K for camera in cameras])
    with atomic_folder(path) as folder:
        whole = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
        save_file(whole, folder / TENSORS)
        description = {
            "format": FORMAT,
            "version": VERSIONS[-1],
            "sha256": digest_file(folder / TENSORS),
            "gaussians": len(gaussians),
            "cameras": [[camera.name, camera.width, camera.height, camera.near] for camera in cameras],
            "info": info,
        }
        write_json(folder / DESCRIPTION, description)


def load_field(path: str | Path) -> dict[str, Any]:
    """The parts of a field, by name; see `SemanticField.load`."""
    path = Path(path)
    if not (path / DESCRIPTION).is_file():
        raise FileNotFoundError(
            f"{path}: expected the folder of a saved field, found no {DESCRIPTION} in it; pass what SemanticField.save got"
        )
    description = read_json(path / DESCRIPTION)
    found = description.get("format") if isinstance(description, dict) else None
    if found != FORMAT:
        raise ValueError(f"{path}: expected a field ({FORMAT}), got {found!r}; pass what SemanticField.save wrote")
    if description.get("version") not in VERSIONS:
        known = " or ".join(map(str, VERSIONS))
        raise ValueError(
            f"{path}: expected format version {known}, got {description.get('version')!r}; use the kfgs that wrote it"
        )
    if not (path / TENSORS).is_file() or digest_file(path / TENSORS) != description.get("sha256"):
        raise ValueError(
            f"{path}: expected {TENSORS} as it was saved, got {'another' if (path / TENSORS).is_file() else 'none'}; "
            "copy the whole folder again, or fit the field again"
        )
    try:
        tensors = load_file(path / TENSORS)
        linear, seen, answers = (_part(tensors, name) for name in ("linear", "seen", "answers"))
        codebook, autoencoder = _part(tensors, "codebook"), _part(tensors, "autoencoder")
        return {
            "gaussians": Gaussians(**_part(tensors, "gaussians")),
            "codebook": Codebook.from_tensors(codebook) if codebook else None,
            "autoencoder": Autoencoder.from_tensors(autoencoder) if autoencoder else None,
            "info": description["info"],
            "linear": LinearLatents.from_tensors(linear) if linear else None,
            "answers": answers.get("latents"),
            "seen": Seen(**seen) if seen else None,
            "cameras": _cameras(description.get("cameras", []), _part(tensors, "cameras")),
        }
    except (SafetensorError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path}: expected a field, but its parts do not fit together ({error}); fit it again"
        ) from error


def _cameras(rows: list[Any], tensors: dict[str, Tensor]) -> tuple[Camera, ...]:
    if not rows:
        return ()
    both = zip(rows, tensors["viewmats"], tensors["Ks"], strict=True)
    return tuple(Camera(E, K, width, height, name, near=near) for (name, width, height, near), E, K in both)


def _part(tensors: dict[str, Tensor], kind: str) -> dict[str, Tensor]:
    prefix = f"{kind}."
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
