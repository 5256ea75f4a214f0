"""The output folder of Inria's 3DGS and its descendants: a scene and its splat at once.

**Convention**: an entry of `cameras.json` has the centre of the camera (`position`) and a camera-to-world rotation
(`rotation`, rows; x right, y down, z forward). `fx`, `fy` are in pixels of `width` x `height`; the principal point is the middle
of the picture. Test views are listed before training views. `cfg_args` is the text of a Python object: it is parsed for three
plain values, and never run.
"""

from __future__ import annotations

import ast
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._files import Names, file_stem
from .._origin import to_world
from ..formats.folders import newest_splat
from ..formats.table import read_splats
from ..formats.values import SH_C0
from .files import SceneError, list_images, read_scene_json, some
from .layouts import NOWHERE, intrinsics
from .posed import PosedPicture, read_points, scene_of_poses
from .scene import Scene

CAMERAS, SETTINGS, POINTS = "cameras.json", "cfg_args", "input.ply"
BLENDER = "transforms_train.json"  # in a folder of Blender's pictures
_LONGEST = 1 << 16  # bytes of cfg_args, which has about 500
_AGAIN = "copy the folder again"


def is_inria(folder: Path) -> bool:
    """Whether this is an output folder of 3DGS."""
    return (folder / CAMERAS).is_file() and newest_splat(folder) is not None


def load_inria(folder: Path, images: Path | None = None) -> Scene:
    """Read the cameras of an output folder of 3DGS, with the pictures that it was trained on.

    Points are those of `input.ply`, else the centres of the newest splat's Gaussians. If `cfg_args` says that views were
    held out (`eval`), they are the `test` split.

    Args:
        folder: with `cameras.json` and `point_cloud/iteration_N/point_cloud.ply`; `cfg_args` may be missing.
        images: the folder of the pictures; None: `images/` in `source_path` of `cfg_args`, also if that folder was moved
            next to this one or above it; else `images/` in this folder; else `source_path` itself, if it is a scene of Blender.

    Raises:
        FileNotFoundError: if there are no pictures.
        SceneError: if a file is damaged, or pictures and cameras do not fit.
    """
    path, settings = folder / CAMERAS, _settings(folder / SETTINGS)
    entries = read_scene_json(path, _AGAIN)
    if not isinstance(entries, list) or not entries:
        raise SceneError(f"{path}: expected a list of cameras, got {type(entries).__name__}; {_AGAIN}")
    pictures = images if images is not None else _find_pictures(folder, settings)
    find, views, missing = _finder(pictures), list[PosedPicture](), list[str]()
    for i, entry in enumerate(entries):
        where = f"{path}, camera {i}"
        given = entry.get("img_name") if isinstance(entry, dict) else None
        if not isinstance(given, str | int) or given == "":
            raise SceneError(f"{where}: expected an object with an 'img_name', got {entry!r:.100}; {_AGAIN}")
        fits = find(str(given))
        if len(fits) > 1:
            raise SceneError(
                f"{where}: expected one picture {given!r} in {pictures}, got {some(sorted(fits))}; load the "
                "folder that 3DGS was trained on, and give this one as the splat (--splat)"
            )
        if fits:
            views.append(_view(fits[0], pictures / fits[0], where, entry))
        else:
            missing.append(str(given))
    if not views:
        raise SceneError(
            f"{pictures}: expected the pictures of {path} ({some(missing, 3)}), found none of them; name the folder that has "
            "them (images=, or --images)"
        )
    lost = f"{len(missing)} of {len(entries)} cameras have no picture in {pictures}: {some(missing)}"
    points, colors, notes = _points(folder)
    scene = scene_of_poses(folder, views, None, (points, colors), [*([lost] if missing else []), *notes])
    order = [view.name for view in views]
    falls = [i for i in range(1, len(order)) if order[i] < order[i - 1]]  # where the order of names begins again
    held_out = set(order[: falls[0]]) if settings.get("eval") is True and len(falls) == 1 else set()
    test = [i for i, camera in enumerate(scene.cameras) if camera.name in held_out]
    return replace(scene, splits={"train": [i for i in range(len(scene)) if i not in test], "test": test})


def _settings(path: Path) -> dict[str, Any]:
    """`source_path`, `images` and `eval` of `cfg_args`, as far as they are there; a SceneError if it is something else."""
    if not path.is_file():
        return {}
    with path.open("rb") as file:
        text = file.read(_LONGEST + 1)
    try:
        if len(text) > _LONGEST:
            raise ValueError(f"more than {_LONGEST} bytes")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of backslashes in paths
            call = ast.parse(text.decode("utf-8-sig").strip(), mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
            raise ValueError("another expression")
        words = {word.arg: word.value for word in call.keywords}
        kinds = {"source_path": str, "images": str, "eval": bool}
        values = {name: ast.literal_eval(words[name]) for name in kinds if name in words}
        odd = [name for name, value in values.items() if not isinstance(value, kinds[name]) or "\0" in str(value)]
        if odd:
            raise ValueError(f"{odd[0]} = {values[odd[0]]!r:.60}")
        return values
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise SceneError(
            f"{path}: expected the text Namespace(source_path='...', ...), got something else ({error}); correct it, or delete "
            "it and name the pictures"
        ) from error


def _find_pictures(folder: Path, settings: dict[str, Any]) -> Path:
    source, name = settings.get("source_path", ""), settings.get("images") or "images"
    last = source.replace("\\", "/").rstrip("/").rpartition("/")[2]
    places = [Path(source), folder / source] if source else []
    places += [folder.parent / last, folder.parent.parent / last] if last else []
    tried = [place / name for place in places] + [folder / name]
    # Only Blender's pictures lie in the source folder itself; a stranger's source folder may be the whole disk
    for place in [*tried, *(place for place in places[:2] if (place / BLENDER).is_file())]:
        if place.is_dir() and list_images(place):
            return place
    raise FileNotFoundError(
        f"{folder}: expected the pictures of {CAMERAS} in one of {', '.join(map(str, dict.fromkeys(tried)))} ({SETTINGS} says "
        f"source_path = {source!r}), found none; name their folder (images=, or --images)"
    )


def _finder(pictures: Path) -> Any:
    """A function that finds pictures by a name of 3DGS, which may lack the folder and the ending."""
    listed = list_images(pictures)
    known: dict[str, list[str]] = {}
    for name in listed:
        bare = name.rpartition("/")[2]
        for short in {name, file_stem(name), bare, file_stem(bare), bare.partition(".")[0]}:
            known.setdefault(short, []).append(name)
    names = Names(listed, bare=True)

    def find(given: str) -> list[str]:
        near = names.find(given)
        return known.get(given) or ([] if near is None else [near])

    return find


def _view(name: str, path: Path, where: str, entry: dict[str, Any]) -> PosedPicture:
    width, height, fx, fy = numbers = [entry.get(key) for key in ("width", "height", "fx", "fy")]
    if any(type(n) is float and not math.isfinite(n) for n in numbers):
        return PosedPicture(name, path, NOWHERE, where, (np.eye(3), (1, 1)))
    middle = [n / 2 if isinstance(n, int | float) else n for n in (width, height)]
    lens, pose = intrinsics([width, height, fx, fy, *middle], where), np.eye(4)
    try:
        rows, centre = np.array(entry["rotation"], np.float64), np.array(entry["position"], np.float64)
        if rows.shape != (3, 3) or centre.shape != (3,):
            raise ValueError(f"{rows.shape} and {centre.shape}")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SceneError(
            f"{where}: expected a rotation [3][3] and a position [3], got {error!r:.100}; {_AGAIN}"
        ) from error
    pose[:3, :3], pose[:3, 3] = rows, centre
    return PosedPicture(name, path, pose, where, lens)


def _points(folder: Path) -> tuple[Tensor, Tensor, list[str]]:
    if (folder / POINTS).is_file():
        return read_points(folder / POINTS)
    try:
        cloud = read_splats(folder)
    except ValueError as error:
        raise SceneError(str(error)) from error
    shades = torch.full((len(cloud), 3), 0.5) if cloud.sh is None else 0.5 + SH_C0 * cloud.sh[:, 0]
    return to_world(cloud.means, cloud.origin), (shades.clamp(0, 1) * 255).round().to(torch.uint8), []
