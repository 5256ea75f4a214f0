"""Labels of any folder: pictures of class ids, coloured pictures with a table, or COCO's JSON."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..._files import as_path, file_stem, read_json, read_text, real_path
from ...scenes.files import list_images, some
from ..class_lists import VOID_NAMES, name_key
from ..truth import LabelTruth
from .coco import load_coco_labels
from .files import ReadWhenAsked, read_pixels
from .replica import ids_in, relabel

TABLES = ("classes.json", "classes.csv", "colors.json", "colors.csv")

Entry = int | tuple[int, int, int]


def load_labels(path: str | Path, table: str | Path | None = None, void: int = 255) -> LabelTruth:
    """Read the label pictures of a folder, or a COCO JSON.

    The pictures have class ids in one channel, or colours. The table names them: `["wall", "floor"]` (ids 0, 1, ...),
    `{"wall": 1, "floor": 2}` or `{"wall": [255, 0, 0], ...}`, a list of `{"name": ..., "id" or "color": ...}`, or CSV lines
    `wall,1` or `wall,255,0,0`. Names in `VOID_NAMES` are void.

    Args:
        path: a folder of PNGs named as the pictures, or `annotations.json` (see `load_coco_labels`).
        table: the table; None: `classes.json`, `classes.csv`, `colors.json` or `colors.csv` in the folder or the one above.
        void: the id that is void unless the table names it.

    Returns:
        Names in the order of the table, and labels by stem, read when asked.

    Raises:
        FileNotFoundError: if the folder, a picture or the table is missing.
        ValueError: if a file is damaged, or a picture has an id or a colour that is not in the table; the message says where.

    Example:
        >>> import json, tempfile, numpy as np
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
    names = tuple(name for name in named if name_key(name) not in VOID_NAMES)
    index = {entry: names.index(name) if name in names else -1 for name, entry in named.items()}
    in_color = isinstance(next(iter(index)), tuple)
    if not in_color:
        index.setdefault(void, -1)
    read: Callable[[Path, Mapping[Any, int], Path], Tensor] = _read_colors if in_color else _read_ids
    readers = {file_stem(name): partial(read, path / name, index, source) for name in files}
    return LabelTruth(names, ReadWhenAsked(readers))


def _find_table(folder: Path) -> Path:
    places = [place / name for place in (folder, real_path(folder).parent) for name in TABLES]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise FileNotFoundError(
            f'{places[0]}: no such file; expected the names of the labels there, such as ["wall", "floor"], or in '
            f"{', '.join(TABLES[1:])}, or one folder above; pass table=PATH"
        )
    return found


def read_table(path: str | Path) -> dict[str, Entry]:
    """The id or the colour of each name, in the order of the file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no table, mixes ids and colours, or has a name or an entry twice.
    """
    path = as_path(path)
    pairs = _csv_pairs(path) if path.suffix.lower() == ".csv" else _json_pairs(path)
    found: dict[str, Entry] = {}
    for name, value in pairs:
        entry = tuple(value) if isinstance(value, list) else value
        colour = isinstance(entry, tuple) and len(entry) == 3 and all(type(v) is int and 0 <= v <= 255 for v in entry)
        whole = type(entry) is int and entry >= 0
        if not (isinstance(name, str) and name and (colour or whole)) or name in found or entry in found.values():
            raise ValueError(
                f"{path}: expected each name once, with an id or a colour [r, g, b] of its own, got {name!r:.40}: {value!r:.40}; "
                "correct the table"
            )
        found[name] = entry  # type: ignore[assignment]
    if not found or len({type(entry) for entry in found.values()}) != 1:
        raise ValueError(
            f"{path}: expected names with ids, or names with colours, got {some(list(found)) or 'none'} of both"
        )
    return found


def _json_pairs(path: Path) -> list[tuple[Any, Any]]:
    top = read_json(path)
    if isinstance(top, dict):
        return list(top.items())
    if isinstance(top, list) and all(isinstance(entry, str) for entry in top):
        return [(name, i) for i, name in enumerate(top)]
    if isinstance(top, list) and all(isinstance(entry, dict) for entry in top):
        return [(entry.get("name"), entry.get("id", entry.get("color"))) for entry in top]
    raise ValueError(f"{path}: expected a list of names or an object of ids or colours, got {str(top)[:80]}")


def _csv_pairs(path: Path) -> list[tuple[Any, Any]]:
    lines = read_text(path, "a table of names with ids or colours").splitlines(keepends=True)
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines) if any(cell.strip() for cell in row)]
    if rows and not rows[0][-1].isdecimal():
        rows = rows[1:]  # a line of titles
    pairs: list[tuple[Any, Any]] = []
    for row in rows:
        numbers = [int(cell) if cell.isdecimal() and cell.isascii() else -1 for cell in row[1:]]
        if len(numbers) not in (1, 3) or min(numbers) < 0:
            raise ValueError(
                f"{path}: expected lines name,id or name,r,g,b, got {','.join(row)[:80]!r}; correct the table"
            )
        pairs.append((row[0], numbers[0] if len(numbers) == 1 else numbers))
    return pairs


def _read_ids(file: Path, index: Mapping[int, int], table: Path) -> Tensor:  # [H, W] int64
    ids = read_pixels(file, "a picture of class ids")
    if ids.ndim != 2:
        raise ValueError(
            f"{file}: expected class ids in one channel, as {table} has ids, got {ids.shape[-1]} channels; give a table of "
            "colours, or write ids"
        )
    whole = ids.astype(np.int64)
    _check_known(file, [(i,) for i in ids_in(whole)], [(i,) for i in index], table, "id")
    return relabel(whole, index)


def _read_colors(file: Path, index: Mapping[tuple[int, int, int], int], table: Path) -> Tensor:  # [H, W] int64
    packed = _packed(read_pixels(file, "a coloured label picture", "RGB").astype(np.int64))
    by_number = {(r << 16) | (g << 8) | b: label for (r, g, b), label in index.items()}
    colors = [(i >> 16, i >> 8 & 255, i & 255) for i in ids_in(packed)]
    _check_known(file, colors, list(index), table, "colour")
    return relabel(packed, by_number)


def _packed(rgb: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    packed: np.ndarray[tuple[int, ...], np.dtype[np.int64]] = (rgb[..., 0] << 16) | (rgb[..., 1] << 8) | rgb[..., 2]
    return packed


def _check_known(file: Path, found: list[Any], known: list[Any], table: Path, kind: str) -> None:
    unknown = [str(value[0] if len(value) == 1 else value) for value in found if value not in set(known)]
    if unknown:
        edges = "; colours that lie between two others come from resizing or JPEG" if kind == "colour" else ""
        raise ValueError(
            f"{file}: expected {kind}s of {table}, got {kind} {some(unknown, 3)} too; add it to the "
            f'table, as "void" if it is not to be scored{edges}'
        )
