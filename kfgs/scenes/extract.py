"""Write a teacher's feature maps of a scene's pictures, one file per picture; a map that exists is not computed again."""

from __future__ import annotations

import inspect
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import one_line
from .._files import as_path, digest_file, locked, read_json, write_json
from .feature_files import ENDINGS, OWN, Size, save_feature_map
from .files import is_inside, read_image, some
from .scene import Scene

MANIFEST, FORMAT, LOCK = "features.json", "kfgs-features/2", ".features.lock"
Split = str | Sequence[str] | Sequence[int]
"""The name of a split, `all`, or a list of view names or indices."""


@dataclass(frozen=True)
class Picture:
    """One picture: the name of its view, its file, and its size if it is known."""

    stem: str
    """The view's name without its suffix; its map has the same stem."""
    path: Path
    size: Size | None = None
    """(H, W) in pixels."""


def pictures_of(scene: Scene, split: Split = "all") -> list[Picture]:
    """The pictures of some views of a scene (a split, `all`, or a list of view names or indices), as they are on disk."""
    chosen = scene.select(scene.views(split) if isinstance(split, str) else split)
    return [Picture(chosen.stem(i), chosen.image_paths[i], chosen.cameras[i].size) for i in range(len(chosen))]


@dataclass(frozen=True)
class Manifest:
    """Which teacher made the maps of a folder, and from which pictures (`features.json`)."""

    teacher: dict[str, Any]
    """The identity of the teacher: its name, weights and options, as JSON."""
    pictures: dict[str, str] = field(default_factory=dict)
    """The SHA-256 of each picture, by the stem of its map."""

    def save(self, folder: Path) -> None:
        """Write `features.json`."""
        write_json(folder / MANIFEST, {"format": FORMAT, **asdict(self)})


def read_manifest(folder: str | Path) -> Manifest | None:
    """The manifest of a folder of maps; None if another program wrote them. A ValueError if it is damaged."""
    path = as_path(folder) / MANIFEST
    if not path.is_file():
        return None
    value = read_json(path)
    entries = value if isinstance(value, dict) and value.get("format") == FORMAT else {}
    teacher, pictures = entries.get("teacher"), entries.get("pictures")
    if not isinstance(teacher, dict) or not isinstance(pictures, dict):
        raise ValueError(
            f"{path}: expected a manifest of kfgs ({FORMAT}), got something else; delete it to use the maps without it, "
            "or delete it and the maps and run `kfgs features`, which makes them again"
        )
    return Manifest(teacher, {str(stem): str(digest) for stem, digest in pictures.items()})


def extract_features(
    teacher: Any,
    pictures: Scene | Sequence[Picture],
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
        pictures: a scene, whose pictures are taken as they are on disk, or a list of `Picture`.
        folder: for the maps; made if it does not exist.
        split: of a scene: the name of a split, `all`, or a list of view names or indices.
        overwrite: replace maps that kfgs made by another teacher (or with other weights or options).
        progress: show a progress bar.

    Returns:
        The manifest, with all maps that kfgs made in the folder.

    Raises:
        ValueError: if there are no pictures; if a map is not [D, h, w], not finite in float16, or has other channels than the
            one before; if the folder holds maps of another teacher or program, or another process is writing to it.
        FileNotFoundError: if a picture is missing.
    """
    folder, (encode, identity) = as_path(folder), _as_encoder(teacher)
    chosen = pictures_of(pictures, split) if isinstance(pictures, Scene) else pictures
    _check_pictures(chosen)
    _check_folder(folder, identity, chosen, overwrite)  # a folder that is refused stays as it is, without a lock file
    with locked(folder, LOCK):
        manifest = read_manifest(folder)
        if manifest is not None and manifest.teacher != identity:
            for stem in filter(is_inside, manifest.pictures):
                (folder / f"{stem}{OWN}").unlink(missing_ok=True)
            manifest = None
        manifest = manifest or Manifest(identity)
        manifest.save(folder)
        channels: int | None = None
        for picture in tqdm(chosen, desc="features", unit="image", disable=not progress):
            digest, file = digest_file(picture.path), folder / f"{picture.stem}{OWN}"
            if file.is_file() and manifest.pictures.get(picture.stem) == digest:
                continue
            with torch.inference_mode():
                features = encode(read_image(picture.path).permute(2, 0, 1).contiguous())
                half = _half(features, f"teacher {identity['name']!r}", picture.path)
            if half.shape[2] != (channels or half.shape[2]):
                raise ValueError(
                    f"teacher {identity['name']!r}: expected {channels} channels for {picture.path} as before, got "
                    f"{half.shape[2]}; use one teacher with the same options for all pictures"
                )
            channels = int(half.shape[2])
            save_feature_map(folder, picture.stem, half)
            manifest = replace(manifest, pictures={**manifest.pictures, picture.stem: digest})
            manifest.save(folder)
    return manifest


def _as_encoder(teacher: Any) -> tuple[Callable[[Tensor], Tensor], dict[str, Any]]:
    """The function from a picture to features, and what is known about the teacher as JSON."""
    encode = getattr(teacher, "encode_image", teacher)
    if inspect.isclass(teacher) or not callable(encode):
        raise TypeError(
            f"teacher: expected an object with encode_image, or a function from [3, H, W] to [D, h, w], got {teacher!r:.80}; "
            "load_teacher(name) loads one"
        )
    name = getattr(teacher, "name", None) or getattr(teacher, "__name__", type(teacher).__name__)
    version = getattr(teacher, "version", "")
    identity = getattr(teacher, "identity", None) or ({"version": str(version)} if version else {})
    try:
        return encode, json.loads(json.dumps({"name": name, **identity}, allow_nan=False))  # tuples become lists
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"teacher.identity: expected plain values that JSON can hold, got {identity!r} ({error}); leave out the rest"
        ) from error


def _check_pictures(pictures: Sequence[Picture]) -> None:
    if not isinstance(pictures, Sequence) or not all(isinstance(picture, Picture) for picture in pictures):
        raise TypeError(f"pictures: expected a Scene or a list of Picture, got {type(pictures).__name__}; load one")
    twice = [stem for stem, count in Counter(picture.stem for picture in pictures).items() if count > 1]
    if not pictures or twice:
        got = f"{some(sorted(twice))} more than once" if twice else "none"
        raise ValueError(f"pictures: expected at least one picture, each stem once, got {got}; rename them")
    for picture in pictures:
        if not is_inside(picture.stem):
            raise ValueError(f"stem: expected a name within the folder, got {picture.stem!r}; rename the picture")
        if not picture.path.is_file():
            raise FileNotFoundError(f"{picture.path}: no such file; expected the picture of view {picture.stem!r}")


def _check_folder(folder: Path, identity: dict[str, Any], pictures: Sequence[Picture], overwrite: bool) -> None:
    """Raise a ValueError if a folder holds maps of another program, or of another teacher."""
    manifest = read_manifest(folder)
    files = (folder / f"{picture.stem}{ending}" for picture in pictures for ending in ENDINGS)
    other = next((file for file in files if file.is_file() and (manifest is None or not file.name.endswith(OWN))), None)
    if other is not None:
        raise ValueError(
            f"{folder}: expected a folder without maps of other programs, got {other.relative_to(folder)} and no record of it "
            f"in {MANIFEST}; use another folder"
        )
    if manifest is not None and manifest.teacher != identity and not overwrite:
        keys = [key for key in {**manifest.teacher, **identity} if manifest.teacher.get(key) != identity.get(key)]
        there, now = ({key: teacher.get(key) for key in keys} for teacher in (manifest.teacher, identity))
        raise ValueError(
            f"{folder}: expected maps of the same teacher as now ({one_line(json.dumps(now), 200)}), got others "
            f"({one_line(json.dumps(there), 200)}); use another folder, or pass overwrite=True to give up its "
            f"{len(manifest.pictures)} maps"
        )


def _half(features: Any, teacher: str, picture: Path) -> Tensor:  # [D, h, w] -> [h, w, D] float16
    """A teacher's answer as it is stored: channels last, rounded to half precision, on the CPU."""
    if not isinstance(features, Tensor) or features.layout != torch.strided:
        raise TypeError(f"{teacher}: expected a dense tensor [D, h, w], got a {type(features).__name__}")
    if features.ndim != 3 or 0 in features.shape or not features.is_floating_point():
        raise ValueError(
            f"{teacher}: expected floats [D, h, w] for one picture, got {features.dtype} {tuple(features.shape)}; leave out "
            "the batch axis"
        )
    half = features.permute(1, 2, 0).to(torch.float16).cpu().contiguous()
    if not bool(torch.isfinite(half).all()):
        raise ValueError(
            f"{teacher}: expected finite features below 65504 (they are stored as float16) for {picture}, got values from "
            f"{float(features.min()):g} to {float(features.max()):g}; check its weights, or scale the rows"
        )
    empty = ~half.any(-1)
    if bool(empty.any()) and bool(features[:, empty.to(features.device)].any()):
        raise ValueError(
            f"{teacher}: expected features above 6e-8 (they are stored as float16) for {picture}, got some that become "
            "all-zero, which means unknown; scale them, or bring the rows to unit length"
        )
    return half
