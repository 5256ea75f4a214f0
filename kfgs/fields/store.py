"""A semantic field on disk: one folder with `field.safetensors` (numbers) and `field.json` (what they are)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from .._files import atomic_folder, digest_file, read_json, write_json
from ..gaussians import Gaussians
from ..quant.autoencoder import Autoencoder
from ..quant.codebook import Codebook

FORMAT, VERSION = "kfgs.semantic_field", 1
TENSORS, DESCRIPTION = "field.safetensors", "field.json"
Parts = tuple[Gaussians, Codebook | None, Autoencoder | None, dict[str, Any]]


def save_field(
    path: str | Path,
    gaussians: Gaussians,
    codebook: Codebook | None,
    autoencoder: Autoencoder | None,
    info: dict[str, Any],
) -> None:
    """Write the folder, replacing a field that lies there and nothing else; see `SemanticField.save`."""
    path = Path(path)
    if path.exists() and not (path / DESCRIPTION).is_file() and not (path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(
            f"path: expected a new folder or an older field at {path}, got something else; give another"
        )
    try:
        json.dumps(info, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"info: expected what JSON can hold, got {error}; use strings and finite numbers") from error
    tensors = {f"gaussians.{name}": value for name, value in vars(gaussians).items() if value is not None}
    if codebook is not None:
        tensors["codebook.codewords"] = codebook.codewords
    if autoencoder is not None:
        tensors |= {f"autoencoder.{name}": value for name, value in autoencoder.to_tensors().items()}
    with atomic_folder(path) as folder:
        whole = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
        save_file(whole, folder / TENSORS)
        description = {
            "format": FORMAT,
            "version": VERSION,
            "sha256": digest_file(folder / TENSORS),
            "gaussians": len(gaussians),
            "info": info,
        }
        write_json(folder / DESCRIPTION, description)


def load_field(path: str | Path) -> Parts:
    """Read the folder; see `SemanticField.load`."""
    path = Path(path)
    if not (path / DESCRIPTION).is_file():
        raise FileNotFoundError(
            f"{path}: expected the folder of a saved field, found no {DESCRIPTION} in it; pass what SemanticField.save got"
        )
    description = read_json(path / DESCRIPTION)
    found = description.get("format") if isinstance(description, dict) else None
    if found != FORMAT:
        raise ValueError(f"{path}: expected a field ({FORMAT}), got {found!r}; pass what SemanticField.save wrote")
    if description.get("version") != VERSION:
        raise ValueError(
            f"{path}: expected format version {VERSION}, got {description.get('version')!r}; use the kfgs that wrote it"
        )
    if not (path / TENSORS).is_file() or digest_file(path / TENSORS) != description.get("sha256"):
        raise ValueError(
            f"{path}: expected {TENSORS} as it was saved, got {'another' if (path / TENSORS).is_file() else 'none'}; "
            "copy the whole folder again, or fit the field again"
        )
    try:
        tensors = load_file(path / TENSORS)
        gaussians = Gaussians(**_part(tensors, "gaussians"))
        codebook, autoencoder = _part(tensors, "codebook"), _part(tensors, "autoencoder")
        return (
            gaussians,
            Codebook.from_tensors(codebook) if codebook else None,
            Autoencoder.from_tensors(autoencoder) if autoencoder else None,
            description["info"],
        )
    except (SafetensorError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path}: expected a field, but its parts do not fit together ({error}); fit it again"
        ) from error


def _part(tensors: dict[str, Tensor], kind: str) -> dict[str, Tensor]:
    prefix = f"{kind}."
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
