"""LERF-OVS: masks and boxes of texts in some pictures of four scenes, as LangSplat published them (one JSON per picture).

**Quirks**: a text is whatever the annotators wrote ("dall-e brand", upper and lower case mixed). Several objects of one
category in a picture are one mask, their union, with a box each. Only texts that a picture's file has are asked there. The
numbers of the published pictures count from 1. LangSplat, LangSplatV2 and GAGS train on these pictures too.
`load_classes("lerf_ovs")` has the numbers, and the texts of OpenGaussian's 3-D protocol.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch

from kfgs._files import as_path, read_json
from kfgs.evaluation.truth import ReadWhenAsked
from kfgs.scenes.files import natural_key, picture_size, some

from ..class_lists import load_classes
from ..mask_truth import MaskAndBoxes, MaskTruth
from ..polygons import MOST, fill_polygon, say_range, union
from .files import find_folder


def load_lerf_ovs(path: str | Path, scene: str | None = None) -> MaskTruth:
    """Read labels in the layout of LERF-OVS: `label/<scene>/frame_00041.json`.

    GAGS's Mip-NeRF360-OVS has the same layout. Polygons are filled as OpenCV does (`fill_polygon`).

    Args:
        path: `lerf_ovs/label/figurines`; or the scene `lerf_ovs/figurines`, whose labels are in `../label/figurines` or in its
            own `label`; or `lerf_ovs` together with `scene`.
        scene: the scene's name, if `path` is the folder of all.

    Returns:
        Masks and boxes of each text, by the stem of the picture; the scene's name is that of its folder.

    Raises:
        FileNotFoundError: if there are no labels, or a published picture of one of the four scenes has none.
        ValueError: if a file is damaged; the message names the file and the object.

    Example:
        >>> import json, tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "label" / "desk"
        >>> folder.mkdir(parents=True)
        >>> cup = {"category": "cup", "segmentation": [[1, 0], [3, 0], [3, 1], [1, 1]], "bbox": [1, 0, 3, 1]}
        >>> top = {"info": {"name": "frame_1.jpg", "width": 5, "height": 3}, "objects": [cup]}
        >>> _ = (folder / "frame_1.json").write_text(json.dumps(top))
        >>> load_lerf_ovs(folder).frames["frame_1"]["cup"].mask.int().tolist()
        [[0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0]]
    """
    path = as_path(path)
    root = path / scene if scene else path
    places = [root.parent / "label" / root.name, root / "label", root]  # a scene may have other JSONs: transforms.json
    folder = (
        find_folder(places, "*.json", "labels of LERF-OVS")
        if scene or not (path / "label").is_dir() or next((path / "label").glob("*.json"), None) is not None
        else _one_scene(path)
    )
    files = sorted(folder.glob("*.json"), key=lambda file: natural_key(file.name))
    stems = {file.stem for file in files}
    missing = [
        f"frame_{n:05d}"
        for n in load_classes("lerf_ovs")["frames"].get(folder.name, ())
        if f"frame_{n:05d}" not in stems
    ]
    if missing:
        raise FileNotFoundError(
            f"{folder}: expected labels of all published pictures of {folder.name}, {some(missing)} missing; download the "
            "labels again"
        )
    name = folder.parent.name if folder.name == "label" else folder.name
    return MaskTruth(ReadWhenAsked({file.stem: partial(read_lerf_json, file) for file in files}), scene=name)


def _one_scene(path: Path) -> Path:
    scenes = sorted(folder.name for folder in (path / "label").iterdir() if folder.is_dir())
    if len(scenes) != 1:
        raise ValueError(f"scene: expected one of {', '.join(scenes) or 'no folder'} (in {path / 'label'}), got None")
    return path / "label" / scenes[0]


def read_lerf_json(path: Path) -> dict[str, MaskAndBoxes]:
    """The masks of one picture.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, of another size than the picture beside it, or an object lies outside its picture.
    """
    top = read_json(path)
    info, objects = (top.get("info"), top.get("objects")) if isinstance(top, dict) else (None, None)
    height, width = (info.get(side) if isinstance(info, dict) else None for side in ("height", "width"))
    if not isinstance(objects, list) or type(height) is not int or type(width) is not int or min(height, width) < 1:
        raise ValueError(
            f'{path}: expected {{"info": {{"name", "width", "height"}}, "objects": [...]}} as in LERF-OVS, got '
            f"{str(top)[:80]}; is this another kind of label file?"
        )
    if height * width > MOST:
        raise ValueError(f"{path}: expected the size of a picture, got {width}x{height}; correct the file")
    picture = path.with_suffix(".jpg")
    if picture.is_file() and (size := picture_size(picture)) != (width, height):
        raise ValueError(
            f"{path}: expected the size of {picture.name} ({size[0]}x{size[1]}), got {width}x{height}; polygons and picture do "
            "not belong together"
        )
    found: dict[str, list[tuple[torch.Tensor, torch.Tensor]]] = {}
    for number, entry in enumerate(objects):
        text, mask, box = _object(path, number, entry, (height, width))
        found.setdefault(text, []).append((mask, box))
    return {
        text: MaskAndBoxes(union([mask for mask, _ in parts]), torch.stack([box for _, box in parts]))
        for text, parts in found.items()
    }


def _object(path: Path, number: int, entry: Any, size: tuple[int, int]) -> tuple[str, torch.Tensor, torch.Tensor]:
    """The text, the mask and the box [4] of an object."""
    values = entry if isinstance(entry, dict) else {}
    text, outline, corners = values.get("category"), values.get("segmentation"), values.get("bbox")
    try:
        points = torch.tensor(outline, dtype=torch.float64)
        box = torch.tensor(corners, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        points, box = torch.zeros(0), torch.zeros(0)
    plain = points.ndim == 2 and points.shape[1:] == (2,) and len(points) > 0 and float(points.abs().max()) < 1e6
    if not isinstance(text, str) or not text or not plain or box.shape != (4,) or not box.isfinite().all():
        raise ValueError(
            f"{path}, object {number} ({text!r:.40}): expected a 'category', a 'segmentation' [[x, y], ...] and a 'bbox' "
            f"[x1, y1, x2, y2], got {str(entry)[:120]}; correct the file"
        )
    mask = fill_polygon(points.numpy(), size)
    if not mask.any():  # the boundary belongs to the mask, so a polygon that touches the picture has a pixel
        raise ValueError(
            f"{path}, object {number} ({text!r:.40}): expected a 'segmentation' in the picture of {size[1]}x{size[0]}, got "
            f"{say_range(points.numpy())}, all outside it; correct the file"
        )
    return text, mask, box
