"""Write a teacher's feature maps of a scene's pictures, one file per picture; a map that exists is not computed again."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from .._check import as_tensor, check_shapes, one_line
from .._files import as_path, atomic_path, digest_file, locked, read_json, write_json
from .files import is_inside, read_image
from .scene import Scene, check_is_scene

MANIFEST, FORMAT, LOCK = "features.json", "kfgs-features/2", ".features.lock"
OWN, FEATURE_3DGS, SAFETENSORS = ".npy", "_fmap_CxHxW.pt", ".safetensors"
ENDINGS = (OWN, FEATURE_3DGS, SAFETENSORS)
"""Endings of a map's file after the picture's stem. If a view has several maps, the first of this order is read."""
Split = str | Sequence[str] | Sequence[int]
"""The name of a split, `all`, or a list of view names or indices."""


@dataclass(frozen=True)
class Manifest:
    """Which teacher made the maps of a folder, and from which pictures (`features.json`)."""

    teacher: dict[str, Any]  # its identity: name, weights and options, as JSON
    pictures: dict[str, str] = field(default_factory=dict)  # the SHA-256 of each picture, by the stem of its map

    def save(self, folder: Path) -> Manifest:
        """Write it to a folder of maps; returns itself."""
        write_json(folder / MANIFEST, {"format": FORMAT, **asdict(self)})
        return self


def read_manifest(folder: str | Path) -> Manifest | None:
    """The manifest of a folder of maps; None if another program wrote them. A ValueError if it is damaged."""
    path = as_path(folder) / MANIFEST
    if not path.is_file():
        return None
    value = read_json(path)
    entries = value if isinstance(value, dict) and value.get("format") == FORMAT else {}
    teacher, pictures = entries.get("teacher"), entries.get("pictures")
    if not isinstance(teacher, dict) or not isinstance(pictures, dict):
        again = "run `kfgs features`, which makes them again"
        advice = f"delete it to use the maps without it, or the maps, too, and {again}"
        raise ValueError(f"{path}: expected a manifest of kfgs ({FORMAT}), got something else; {advice}")
    return Manifest(teacher, {str(stem): str(digest) for stem, digest in pictures.items()})


def extract_features(
    teacher: Any,
    scene: Scene,
    folder: str | Path,
    split: Split = "train",
    *,
    overwrite: bool = False,
    progress: bool = False,
) -> Manifest:
    """Write a teacher's map of each picture to a folder that `FeatureFolder` reads. After a killed call, call it again.

    A map is `<stem>.npy`, float16 [h, w, D]; `features.json` records which teacher made it from which picture. A map is made if
    there is none, or if its picture has changed.

    Args:
        teacher: an object with `encode_image`, from [3, H, W] RGB in [0, 1] to [D, h, w], a `name` and perhaps `identity`
            (JSON of everything that the features depend on: weights, options), as in `kfgs.teachers`; or a function, which is
            known by its name alone.
        scene: its pictures are taken as they are on disk.
        folder: for the maps; made if it does not exist.
        split: the name of a split, `all`, or a list of view names or indices.
        overwrite: replace maps that kfgs made by another teacher (or with other weights or options).
        progress: show a progress bar.

    Returns:
        The manifest, with all maps that kfgs made in the folder.

    Raises:
        ValueError: if there are no pictures; if a map is not [D, h, w], not finite in float16, or has other channels than the
            one before; if the folder holds maps of another teacher or program, or another process is writing to it.
        FileNotFoundError: if a picture is missing.
    """
    check_is_scene(scene)
    folder, (encode, identity), chosen = as_path(folder), as_encoder(teacher), scene.select(split)
    pictures = {chosen.stem(i): path for i, path in enumerate(chosen.image_paths)}
    if not pictures:
        raise ValueError("split: expected at least one view, got none; name some")
    for stem, path in pictures.items():
        if not is_inside(stem):
            raise ValueError(f"scene: expected names inside the folder, got {stem!r}; rename the picture")
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; expected the picture of view {stem!r}")
    manifest = read_manifest(folder)  # before the lock: a refused folder stays as it is
    files = (folder / f"{stem}{ending}" for stem in pictures for ending in ENDINGS)
    other = next((file for file in files if file.is_file() and (manifest is None or not file.name.endswith(OWN))), None)
    if other is not None:
        got = f"{other.relative_to(folder)} and no record of it in {MANIFEST}"
        raise ValueError(f"{folder}: expected a folder without maps of other programs, got {got}; use another folder")
    if manifest is not None and manifest.teacher != identity and not overwrite:
        keys = [key for key in {**manifest.teacher, **identity} if manifest.teacher.get(key) != identity.get(key)]
        values = ({key: about.get(key) for key in keys} for about in (manifest.teacher, identity))
        there, now = (one_line(json.dumps(value), 200) for value in values)
        advice = f"use another folder, or pass overwrite=True to give up its {len(manifest.pictures)} maps"
        raise ValueError(f"{folder}: expected maps of the same teacher as now ({now}), got others ({there}); {advice}")
    with locked(folder, LOCK):
        manifest = read_manifest(folder) or Manifest(identity)
        if manifest.teacher != identity:
            for stem in filter(is_inside, manifest.pictures):
                (folder / f"{stem}{OWN}").unlink(missing_ok=True)
            manifest = Manifest(identity)
        manifest.save(folder)
        channels: int | None = None
        for stem, path in tqdm(pictures.items(), desc="features", unit="image", disable=not progress):
            digest, file = digest_file(path), folder / f"{stem}{OWN}"
            if file.is_file() and manifest.pictures.get(stem) == digest:
                continue
            with torch.inference_mode():
                answer = encode(read_image(path).permute(2, 0, 1).contiguous())
            try:
                features = as_tensor("features", answer, floating=True)
                if features.layout != torch.strided:
                    raise TypeError(f"features: expected a dense tensor, got {features.layout}; call its to_dense()")
                check_shapes(("features", features, "D h w" if channels is None else (channels, "h", "w")))
                save_feature_map(folder, stem, features.permute(1, 2, 0))
            except (ValueError, TypeError) as error:
                raise type(error)(f"teacher {identity['name']!r}, for {path}: {error}") from error
            channels = int(features.shape[0])
            manifest = replace(manifest, pictures={**manifest.pictures, stem: digest}).save(folder)
    return manifest


def as_encoder(teacher: Any) -> tuple[Callable[[Tensor], Tensor], dict[str, Any]]:
    """The function from a picture to features, and what is known about the teacher as JSON."""
    encode, version = getattr(teacher, "encode_image", teacher), str(getattr(teacher, "version", None) or "")
    if inspect.isclass(teacher) or not callable(encode):
        expected = "an object with encode_image, or a function from [3, H, W] to [D, h, w]"
        raise TypeError(f"teacher: expected {expected}, got {teacher!r:.80}; load_teacher(name) loads one")
    name = getattr(teacher, "name", None) or getattr(teacher, "__name__", type(teacher).__name__)
    identity = getattr(teacher, "identity", None) or ({"version": version} if version else {})
    try:
        return encode, json.loads(json.dumps({"name": name, **identity}, allow_nan=False))  # tuples become lists
    except (TypeError, ValueError) as error:
        raise TypeError(f"teacher.identity: expected values that JSON can hold, got {identity!r} ({error})") from error


def count_bad(values: Tensor) -> int:  # any shape, not empty
    """Count NaN and infinite values; if the extremes are finite there are none, and the tensor is not copied."""
    low, high = values.aminmax()  # NaN if any value is
    return 0 if math.isfinite(low) and math.isfinite(high) else int((~torch.isfinite(values)).sum())


def save_feature_map(path: str | Path, stem: str, features: Tensor) -> Path:  # features: [h, w, D]
    """Write one view's map as kfgs stores it: `<stem>.npy`, float16 [h, w, D]; the file appears whole or not at all.

    Raises:
        ValueError: if `features` is not [h, w, D], not finite in float16 (largest value 65504), or becomes all-zero there in
            some cells but not before (below 6e-8).
    """
    features = as_tensor("features", features, floating=True)
    check_shapes(("features", features, "h w D"))
    half = features.detach().to(torch.float16).cpu().contiguous()
    empty = ~half.any(-1)
    if 0 in half.shape or count_bad(half) or bool(features[empty.to(features.device)].any()):
        low, high = (float(end) for end in features.aminmax()) if features.numel() else (0.0, 0.0)
        expected = "finite values below 65504 and, where they are not all zero, above 6e-8 (they are stored as float16)"
        advice = "bring the rows to unit length" if math.isfinite(low + high) else "check the weights of its network"
        got = f"{tuple(half.shape)} from {low:g} to {high:g} for {stem!r}"
        raise ValueError(f"features: expected {expected}, got {got}; {advice}")
    target = as_path(path) / f"{stem}{OWN}"
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        np.save(file, half.numpy())
    return target
