"""Open a scene folder, whichever program wrote it."""

from __future__ import annotations

import shlex
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from .._check import check_choice
from .._files import as_path, real_path
from .._notes import tell_repairs
from ..cameras.camera import Camera
from .colmap import load_colmap
from .colmap_model import count_images, has_model
from .files import SceneError, check_mask, folder_masks, natural_key, picture_folder, picture_size, some
from .layouts import LAYOUTS, find_layout
from .scene import RULES, Scene, make_split, read_split
from .transforms import load_transforms

PLACES = ("sparse", "colmap/sparse", "dense/sparse", "distorted/sparse", "colmap_ground_truth", ".")
"""Folders of models, asked in this order; a model may also lie in their subfolders `N`, `N/models/M` and `models/M`."""
PICTURES = ("images", "images_2", "images_4", "images_8", "color", "results", "rgb", "train", "val", "test")
SCENE_PARTS = ("features", "sparse", "labels", "labels_scored", "masks", "depth", "pose", *PICTURES)
"""Folders of a scene that hold what it is read from."""
LONG_VIDEO = 200  # frames of Replica: neighbours show the same, so that every tenth is enough
SplitChoice = Literal["auto", "df3dgs", "feature3dgs", "holdout8", "all"]


def load_scene(
    path: Any, *, images: str | Path | None = None, split: SplitChoice = "auto", strict: bool = False
) -> Scene:
    """Open a folder with pictures and their poses, in the layout of COLMAP, nerfstudio, Replica or ScanNet.

    The first of these is read: a COLMAP model in `sparse`, `colmap/sparse`, `dense/sparse`, `distorted/sparse`,
    `colmap_ground_truth` or the folder itself (of several the one with most images); `transforms.json`;
    Blender's `transforms_train.json`; Replica as NICE-SLAM or Semantic-NeRF rendered it; ScanNet.

    Args:
        path: the scene folder, a model folder, or a .json file; or a `pycolmap.Reconstruction`, which needs `images`.
        images: the image folder, also by its name in the scene folder; cameras are resized to its pictures. None: `images/`
            next to the model or above it, else the first of `images_2`, `images_4`, ..., else the scene folder.
        split: `"auto"`: split.json, else lists of names (`test.txt`, `train_list.txt`, ...), else the split of the
            transforms.json, else `"df3dgs"` for the videos of Replica, `"holdout8"` from 8 images, below 8 `"all"`; or a rule
            of `make_split`.
        strict: refuse a scene of which something broken was left out or mended; else the notes say it.

    Returns:
        The scene, with views in natural order of names, and cameras with a `near` for the size of the scene
        (`Scene.with_near`). Its `notes` list missing files and assumptions.

    Raises:
        FileNotFoundError: if there is no such folder, or no image folder.
        SceneError: if there is no scene, or it cannot be used.
        ValueError: if `split` is unknown.
    """
    if hasattr(path, "points3D"):  # a reconstruction; what COLMAP can write is read, with all checks
        if images is None:
            raise ValueError("images: expected the folder of the pictures of a Reconstruction, got None; pass it")
        with tempfile.TemporaryDirectory() as written:
            path.write(written)
            return replace(load_scene(written, images=images, split=split, strict=strict), folder=None)
    path = as_path(path)
    check_choice("split", split, ("auto", *RULES))
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder; expected a scene there")
    root, model = scene_root(path), find_model(path)
    if images is not None and not as_path(images).is_dir() and (root / images).is_dir():
        images = root / images
    scene = replace(_load_views(path, model, None if images is None else as_path(images)), folder=root)
    if scene.masks is None:  # its file names none
        pictures = picture_folder(scene[0].name, scene.image_paths[0])
        masks, notes = folder_masks([camera.name for camera in scene], pictures, root)
        scene = replace(scene, masks=masks, notes=(*scene.notes, *notes))
    for mask, camera in zip(scene.masks or (), scene.cameras, strict=scene.masks is not None):
        if mask is not None:
            check_mask(mask, picture_size(mask), camera.size)
    tell_repairs(str(path), scene.notes, strict, SceneError)
    return _with_split(scene, path, root, model, split)


def load_cameras(path: str | Path) -> list[Camera]:
    """The cameras of a scene, or of a camera path of your own, in natural order of their names, without lens distortion.

    The pictures of a COLMAP model or a transforms.json are not needed. A frame of a transforms.json needs no `file_path`
    either; its number is then its name. A SceneError if there are no cameras, or they cannot be used.
    """
    path = as_path(path)
    model = find_model(path)
    if model is None and not (path.exists() and _is_transforms(path)):
        return load_scene(path).undistorted().cameras
    scene = load_transforms(path, pictures=False) if model is None else load_colmap(model, None)
    tell_repairs(str(path), scene.notes, False, SceneError)
    return scene.undistorted().cameras


def scene_root(path: Path) -> Path:
    """The folder of a scene that is given by a folder or a .json file."""
    return path if path.is_dir() else path.parent


def _load_views(path: Path, model: Path | None, images: Path | None) -> Scene:
    if model is not None:
        scene = load_colmap(model, images or _find_images(path, model))
        counts = {other.relative_to(path): count_images(other) for other in _models_of(path) if other != model}
        if not counts:
            return scene
        others = [f"{name}, which is damaged" if n is None else f"{name} with {n} images" for name, n in counts.items()]
        used = f"{model.relative_to(path)} with {count_images(model)} images is used, the largest of several models"
        advice = f"to use another, give its folder as the scene, as in {path / next(iter(counts))}"
        return replace(scene, notes=(*scene.notes, f"{used}; there is {some(others)} too: {advice}"))
    if _is_transforms(path):
        return load_transforms(path, images)
    layout = find_layout(path)
    if layout is not None:
        return layout.read(path)
    there = [(file, layout) for layout in LAYOUTS for file in layout.files if (path / file).exists()][:1]
    half = "".join(f" (there is {file}, but not all of {row.name}: {' and '.join(row.files)})" for file, row in there)
    what = "expected a COLMAP model, a transforms.json or the layout of a data set (docs/datasets.md), found none"
    inside = [folder.name for folder in _folders(path)[:100] if is_scene(folder)]
    advice = f"estimate the cameras first: `kfgs sfm {shlex.quote(str(path))} --out scene/`, or run_sfm"
    if inside:
        advice = f"it holds scenes ({some(inside)}): give one of them, as in {path / inside[0]}"
    elif is_scene(real_path(path).parent):
        advice = f"the folder above is a scene: give {real_path(path).parent}"
    raise SceneError(f"{path}: {what}{half}; {advice}")


def _is_transforms(path: Path) -> bool:
    return path.suffix == ".json" or any((path / f"transforms{end}.json").is_file() for end in ("", "_train"))


def is_scene(path: str | Path) -> bool:
    """Whether a folder has poses: a COLMAP model, a transforms.json, or the layout of a data set."""
    path = as_path(path)
    return (path.is_dir() and (_is_transforms(path) or find_layout(path) is not None)) or find_model(path) is not None


def _find_images(root: Path, model: Path) -> Path:
    """The folder with the pictures of a scene's model; see `load_scene`."""
    folders = _above(model)
    dense = [folder for folder in folders if folder.name in ("dense", "distorted")]  # pictures of their own
    places = list(dict.fromkeys((*dense, root, *folders)))
    full = [folder / "images" for folder in places]
    numbered = (sorted(folder.glob("images_*"), key=lambda inner: natural_key(inner.name)) for folder in places)
    small = [inner for folders in numbered for inner in folders if inner.name[7:].isdecimal()]
    undistorted = [folder / "input" for folder in dense]
    return next((folder for folder in (*full, *small, *undistorted) if folder.is_dir()), root)


def _with_split(scene: Scene, path: Path, root: Path, model: Path | None, split: SplitChoice) -> Scene:
    names = [camera.name for camera in scene.cameras]
    homes = [root] if model is None else list(dict.fromkeys((model, root, *_above(model)[: 4 if model == path else 0])))
    if split == "auto":
        homes.sort(key=lambda home: not (home / "split.json").is_file())  # before any lists
        chosen = next((lists for home in homes if (lists := read_split(home, names)) is not None), None)
        if chosen is not None:
            return replace(scene, splits=chosen[0], notes=(*scene.notes, *chosen[1]))
        if scene.splits.get("test") or len(scene.splits["train"]) < len(scene):  # of its own lists
            return scene
    layout, rule = None if model is not None else find_layout(root), split
    if rule == "auto":
        long_video = layout is not None and layout.video and len(scene) >= LONG_VIDEO
        rule = "df3dgs" if long_video else "holdout8" if len(scene) >= 8 else "all"
    splits = make_split(len(scene), rule)
    note = f"split {rule}: {len(splits['train'])} of {len(scene)} views train, {len(splits['test'])} test"
    if not splits["train"]:
        needed = f"at least 6 views for the split {rule!r}, got {len(scene)}"
        raise SceneError(f'{root}: expected {needed}; use split="all" or "holdout8"')
    return replace(scene, splits=splits, notes=(*scene.notes, note))


def _models_of(path: Path) -> list[Path]:
    """The models of the first of `PLACES` that has some; in a subfolder without a number only if there is no other."""
    for folder in (path / place for place in PLACES) if path.is_dir() else ():
        inner = [] if folder == path else [below for below in _folders(folder) if below.name != "models"]
        numbered = [below for below in inner if below.name.isdecimal()]
        hloc = [model for below in (folder, *numbered) for model in _folders(below / "models")]
        for places in ([*numbered, *hloc, folder], inner):
            if models := [place for place in places if has_model(place)]:
                return models
    return []


def find_model(path: Path) -> Path | None:
    """The COLMAP model that `load_scene` reads in a scene folder, the one with most images; None if there is none."""
    return max(_models_of(path), key=lambda model: count_images(model) or 0, default=None)  # the first of equal ones


def _above(model: Path) -> list[Path]:
    """The folders above a model that may be its scene, nearest first: two, or all up to the one that holds `PLACES`."""
    parents = list(real_path(model).parents)[:6]
    names = [folder.name for folder in parents]
    if "sparse" not in names:
        return parents[:2]
    count = names.index("sparse") + 2
    return parents[: count + (names[count - 1 : count] in (["colmap"], ["dense"], ["distorted"]))]


def _folders(folder: Path) -> list[Path]:
    inner = filter(Path.is_dir, folder.iterdir() if folder.is_dir() else ())
    return sorted(inner, key=lambda below: natural_key(below.name))
