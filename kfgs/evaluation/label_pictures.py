"""Pictures of labels: class ids or colours, with a table that names them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._files import as_path, file_stem, read_json, real_path
from ..scenes.files import list_images, open_picture, some
from .coco import load_coco_labels
from .truth import LabelTruth, ReadWhenAsked, is_void

VOID = 255
TABLES = ("classes.json", "colors.json")

Entry = int | tuple[int, int, int]
Ids = NDArray[np.int64]


def load_label_map(path: str | Path) -> Tensor:  # [H, W] int64, -1 = void
    """Read a label picture (8-bit class indices, 255 = void).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not an 8-bit single-channel picture.
    """
    path = as_path(path)
    with open_picture(path, "a picture of labels", "write it again") as picture:
        mode, values = picture.mode, np.array(picture)
    if mode not in ("L", "P"):
        raise ValueError(f"{path}: expected 8-bit class indices (mode L or P), got mode {mode}")
    labels = torch.from_numpy(values).long()
    return torch.where(labels == VOID, -1, labels)


def load_labels(path: str | Path, table: str | Path | None = None, void: int = VOID) -> LabelTruth:
    """Read the label pictures of a folder, or a COCO JSON.

    The pictures have class ids in one channel, or colours. The table names them: `["wall", "floor"]` (ids 0, 1, ...),
    `{"wall": 1, "floor": 2}` or `{"wall": [255, 0, 0], ...}`, or a list of `{"name": ..., "id" or "color": ...}`. Names in
    `VOID_NAMES` are void.

    Args:
        path: a folder of PNGs named as the pictures, or `annotations.json` (see `load_coco_labels`).
        table: the table; None: `classes.json` or `colors.json` in the folder or the one above.
        void: the id that is void unless the table names it.

    Returns:
        Names in the order of the table, and labels by stem, read when asked.

    Raises:
        FileNotFoundError: if the folder, a picture or the table is missing.
        ValueError: if a file is damaged, or a picture has an id or a colour that is not in the table; the message says where.

    Example:
        >>> import json, tempfile
        >>> from PIL import Image
        >>> folder = Path(tempfile.mkdtemp())
        >>> Image.fromarray(np.uint8([[7, 9], [255, 7]])).save(folder / "rgb_1.png")
        >>> _ = (folder / "classes.json").write_text(json.dumps({"wall": 7, "floor": 9}))
        >>> load_labels(folder).maps["rgb_1"].tolist()
        [[0, 1], [-1, 0]]
    """
    path = as_path(path)
    if path.suffix == ".json" and path.is_file():
        return load_coco_labels(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder; expected label pictures there, or a COCO .json")
    files = [name for name in list_images(path) if name.lower().endswith(".png")]
    if not files:
        raise FileNotFoundError(
            f"{path}: expected label pictures (.png) there, found none; JPEGs would change the labels"
        )
    source = _find_table(path) if table is None else as_path(table)
    named = read_table(source)
    names = tuple(name for name in named if not is_void(name))
    index = {entry: names.index(name) if name in names else -1 for name, entry in named.items()}
    read: Callable[[Path, Mapping[Any, int], Path], Tensor] = _read_ids
    if isinstance(next(iter(index)), tuple):
        read = _read_colors
    else:
        index.setdefault(void, -1)
    readers = {file_stem(name): partial(read, path / name, index, source) for name in files}
    return LabelTruth(names, ReadWhenAsked(readers))


def _find_table(folder: Path) -> Path:
    places = [place / name for place in (folder, real_path(folder).parent) for name in TABLES]
    table = next((place for place in places if place.is_file()), None)
    if table is None:
        raise FileNotFoundError(
            f'{places[0]}: no such file; expected the names of the labels there, such as ["wall", "floor"], or in '
            f"{TABLES[1]}, or one folder above; pass table=PATH"
        )
    return table


def read_table(path: Path) -> dict[str, Entry]:
    """The id or the colour of each name, in the order of the file."""
    table: dict[str, Entry] = {}
    for name, value in _pairs(path):
        entry: Any = tuple(value) if isinstance(value, list) else value
        colour = isinstance(entry, tuple) and len(entry) == 3 and all(type(v) is int and 0 <= v <= 255 for v in entry)
        whole = type(entry) is int and entry >= 0
        if not (isinstance(name, str) and name and (colour or whole)) or name in table or entry in table.values():
            raise ValueError(
                f"{path}: expected each name once, with an id or a colour [r, g, b] of its own, got {name!r:.40}: "
                f"{value!r:.40}; correct the table"
            )
        table[name] = entry
    if not table or len({type(entry) for entry in table.values()}) != 1:
        raise ValueError(
            f"{path}: expected names with ids, or names with colours, got {some(list(table)) or 'none'} of both"
        )
    return table


def _pairs(path: Path) -> list[tuple[Any, Any]]:
    top = read_json(path)
    if isinstance(top, dict):
        return list(top.items())
    if isinstance(top, list) and all(isinstance(entry, str) for entry in top):
        return [(name, i) for i, name in enumerate(top)]
    if isinstance(top, list) and all(isinstance(entry, dict) for entry in top):
        return [(entry.get("name"), entry.get("id", entry.get("color"))) for entry in top]
    raise ValueError(f"{path}: expected a list of names or an object of ids or colours, got {str(top)[:80]}")


def read_ids(file: Path, advice: str) -> Ids:
    """The class ids of a picture with one channel; the error about another one ends with `advice`."""
    with open_picture(file, "a picture of class ids", "copy it again") as picture:
        ids = np.asarray(picture)
    if ids.ndim != 2:
        raise ValueError(f"{file}: expected class ids in one channel, got {ids.shape[-1]} channels; {advice}")
    return ids.astype(np.int64)


def relabel(ids: Ids, index: Mapping[int, int]) -> tuple[Tensor, list[int]]:  # [H, W] int64
    """Indices for ids, -1 for an id without one; and the ids that have none."""
    unique, inverse = np.unique(ids, return_inverse=True)
    labels = np.array([index.get(int(i), -1) for i in unique], dtype=np.int64)
    return torch.from_numpy(labels[inverse.reshape(ids.shape)]), [int(i) for i in unique if int(i) not in index]


def _read_ids(file: Path, index: Mapping[int, int], table: Path) -> Tensor:  # [H, W] int64
    ids = read_ids(file, f"{table} has ids: give a table of colours, or write ids")
    labels, unknown = relabel(ids, index)
    _check_known(file, list(map(str, unknown)), table, "id")
    return labels


def _read_colors(file: Path, index: Mapping[tuple[int, int, int], int], table: Path) -> Tensor:  # [H, W] int64
    with open_picture(file, "a coloured label picture", "copy it again") as picture:
        rgb = np.asarray(picture.convert("RGB")).astype(np.int64)
    packed = (rgb[..., 0] << 16) | (rgb[..., 1] << 8) | rgb[..., 2]
    labels, unknown = relabel(packed, {(r << 16) | (g << 8) | b: label for (r, g, b), label in index.items()})
    colors = [str((i >> 16, i >> 8 & 255, i & 255)) for i in unknown]
    _check_known(file, colors, table, "colour", "; colours that lie between two others come from resizing or JPEG")
    return labels


def _check_known(file: Path, unknown: list[str], table: Path, kind: str, why: str = "") -> None:
    if unknown:
        raise ValueError(
            f"{file}: expected {kind}s of {table}, got {kind} {some(unknown, 3)} too; add it to the "
            f'table, as "void" if it is not to be scored{why}'
        )
