"""Open a scene folder, whichever program wrote it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from .._check import check_choice
from .colmap import load_colmap
from .colmap_model import has_model
from .files import SceneError, some
from .scene import Scene
from .splits import choose_split, make_split, read_split
from .transforms import load_transforms

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap_ground_truth", ".")
_TRANSFORMS = ("transforms.json", "transforms_train.json")

SplitChoice = Literal["auto", "file", "df3dgs", "holdout8", "all"]


def load_scene(path: str | Path, *, images: str | Path | None = None, split: SplitChoice = "auto") -> Scene:
    """Open a folder with images and a COLMAP model, or with a transforms.json.

    The first of these is read: a COLMAP model in `sparse/0`, `sparse`, `colmap/sparse/0`, `colmap_ground_truth` or the
    folder itself (binary before text); `transforms.json`; Blender's `transforms_train.json`.

    Args:
        path: the scene folder, a model folder, or a .json file.
        images: the image folder; None: `images/` next to the model or up to two folders above it, else the scene folder.
        split: `"auto"`: split.json if there is one, else the split of the transforms.json if it has one, else by number
            of images: from 200 the paper's (which trains on every 10th image only), from 8 `"holdout8"`, below 8 all;
            `"file"`: split.json; or a rule of `make_split`.

    Returns:
        The scene, with views in natural order of names, and cameras with a `near` for the size of the scene
        (`Scene.with_near`). Its `notes` list missing files and assumptions.

    Raises:
        FileNotFoundError: if there is no such folder, no image folder, or (`split="file"`) no split.json.
        SceneError: if there is no scene, or it cannot be used.
        ValueError: if `split` is unknown.
    """
    path = Path(path)
    check_choice("split", split, ("auto", "file", "df3dgs", "holdout8", "all"))
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder; expected a scene there")
    root = path if path.is_dir() else path.parent
    scene = replace(_load_views(path, root, images), folder=root)
    return _with_split(scene, root, split)


def _load_views(path: Path, root: Path, images: str | Path | None) -> Scene:
    if path.is_dir():
        for name in MODEL_FOLDERS:
            if has_model(path / name):
                model = path / name
                scene = load_colmap(model, images if images is not None else _image_folder(path, model))
                others = sorted(f.name for f in model.parent.iterdir() if f != model and has_model(f))
                if name == "sparse/0" and others:
                    note = f"{model.parent} holds other models too ({some(others)}): COLMAP split the images; 0 is used"
                    scene = replace(scene, notes=(*scene.notes, note))
                return scene
    if path.suffix == ".json" or any((path / name).is_file() for name in _TRANSFORMS):
        return load_transforms(path, images)
    raise SceneError(
        f"{path}: expected a COLMAP model (in {', '.join(MODEL_FOLDERS)}) or a transforms.json, found neither; "
        "estimate the cameras first: `kfgs sfm <images> <scene>` or kfgs.scenes.run_sfm"
    )


def _image_folder(root: Path, model: Path) -> Path:
    for above in dict.fromkeys((root, model.resolve().parent, model.resolve().parent.parent)):
        if (above / "images").is_dir():
            return above / "images"
    return root


def _with_split(scene: Scene, root: Path, split: SplitChoice) -> Scene:
    file = root / "split.json"
    if split == "file" or (split == "auto" and file.is_file()):
        splits, unknown = read_split(file, [scene.stem(i) for i in range(len(scene))])
        notes = [f"{len(unknown)} names in {file} are not in the scene: {some(unknown)}"] if unknown else []
        return replace(scene, splits=splits, notes=(*scene.notes, *notes))
    if split == "auto" and scene.splits.get("test"):
        return scene
    rule = choose_split(len(scene)) if split == "auto" else split
    assert rule != "file"
    splits = make_split(len(scene), rule)
    note = f"split {rule}: {len(splits['train'])} of {len(scene)} views train, {len(splits['test'])} test"
    if split == "auto" and rule == "df3dgs":
        note += ' (the paper\'s, for 900 frames of video); split="holdout8" trains on 7 of 8 views'
    if not splits["train"]:
        raise SceneError(
            f'{root}: expected at least 6 views for the split {rule!r}, got {len(scene)}; use split="all" or "holdout8"'
        )
    return replace(scene, splits=splits, notes=(*scene.notes, note))
