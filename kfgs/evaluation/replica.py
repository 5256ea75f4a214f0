"""Replica's semantic mesh, and the label pictures that Semantic-NeRF rendered from it."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElementParseError
from torch import Tensor

from .._arrays import reading
from .._files import as_path, read_json, real_path
from ..scenes.files import natural_key, some
from .label_pictures import Ids, read_ids, relabel
from .truth import LabelTruth, PointTruth, ReadWhenAsked, in_world

INFO = "info_semantic.json"
ADVICE = "give semantic_class/, not vis_*"


def load_replica_points(path: str | Path) -> PointTruth:
    """Read `habitat/mesh_semantic.ply` (an object per face) and `habitat/info_semantic.json` (a class per object).

    A vertex has the object of most of its faces, of equally many the one with the lowest id.

    Args:
        path: the scene of Replica (`room_0`), its `habitat`, or the mesh.

    Returns:
        All vertices in the mesh's frame, which is that of NICE-SLAM's and Semantic-NeRF's poses; labels are Replica's class
        ids, -1 = none; instances are its object ids.

    Raises:
        FileNotFoundError: if one of the two files is missing.
        ValueError: if one is damaged, or a face has no object.
    """
    path = as_path(path)
    places = [path] if path.suffix == ".ply" else [path / "habitat" / "mesh_semantic.ply", path / "mesh_semantic.ply"]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise FileNotFoundError(f"{places[0]}: no such file; expected Replica's mesh with an object per face there")
    names, of_object = read_replica_info(file.with_name(INFO))
    points, corners, counts, objects = _read_mesh(file)
    instances = _most_frequent(corners, np.repeat(objects, counts), len(points))
    unique, inverse = np.unique(instances, return_inverse=True)
    labels = np.array([of_object.get(int(o), -1) for o in unique], dtype=np.int64)[inverse]
    return PointTruth(in_world(torch.from_numpy(points)), torch.from_numpy(labels), names, torch.from_numpy(instances))


def _read_mesh(file: Path) -> tuple[NDArray[np.float64], Ids, Ids, Ids]:
    """Vertices [N, 3]; the corners [C] of all faces, one face after another; how many each has [F], and its object [F]."""
    with reading(file, "a mesh with vertices and faces with an 'object_id' (habitat/mesh_semantic.ply, not mesh.ply)"):
        try:  # mapped if all faces are quads, as in most rooms; others are read one by one
            ply = PlyData.read(file, known_list_len={"face": {"vertex_indices": 4}})
        except PlyElementParseError:
            ply = PlyData.read(file)
        faces, objects = np.asarray(ply["face"]["vertex_indices"]), np.array(ply["face"]["object_id"], np.int64)
        points = np.stack([ply["vertex"][axis] for axis in "xyz"], 1).astype(np.float64)
        corners = np.concatenate([np.zeros(0, np.int64), *faces]).astype(np.int64)
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(points):
            raise ValueError(f"it has {len(points)} vertices, and a face of vertex {corners.max()}")
        return points, corners, np.array([len(face) for face in faces], np.int64), objects


def load_semantic_nerf_labels(path: str | Path, info: str | Path | None = None) -> LabelTruth:
    """Read the label pictures of Semantic-NeRF's renders: `semantic_class/semantic_class_0.png` for `rgb_0`.

    Args:
        path: the sequence, with `rgb/` and `semantic_class/`.
        info: Replica's `info_semantic.json` of the scene; None: in the folder, or up to two above it, also in `habitat`.

    Returns:
        The classes that the pictures show, in the order of Replica's ids; id 0 and ids without a name are void.

    Raises:
        FileNotFoundError: if there are no pictures, or no `info_semantic.json`.
        ValueError: if one is damaged, or no picture shows a named class.
    """
    path = as_path(path)
    folder = path / "semantic_class"
    files = sorted(folder.glob("semantic_class_*.png"), key=lambda file: natural_key(file.name))
    if not files:
        raise FileNotFoundError(
            f"{folder}: expected semantic_class_0.png and so on, found none; give the sequence's folder"
        )
    above = [path, *list(real_path(path).parents)[:2]]
    places = [as_path(info)] if info is not None else [f / name for f in above for name in (INFO, f"habitat/{INFO}")]
    table = next((place for place in places if place.is_file()), None)
    if table is None:
        raise FileNotFoundError(
            f"{places[0]}: no such file; expected Replica's {INFO} of the scene, which names the classes; pass info=PATH"
        )
    named, _ = read_replica_info(table)
    shown = {int(i) for file in files for i in np.unique(read_ids(file, ADVICE))}
    seen = sorted(shown & {i for i in named if i > 0})
    if not seen:
        raise ValueError(
            f"{folder}: expected class ids of {table}, none of {len(files)} pictures shows one; is it this scene's?"
        )
    index = {old: new for new, old in enumerate(seen)}

    def read(file: Path) -> Tensor:  # [H, W] int64
        return relabel(read_ids(file, ADVICE), index)[0]

    readers = {f"rgb_{file.stem.removeprefix('semantic_class_')}": partial(read, file) for file in files}
    return LabelTruth(tuple(named[i] for i in seen), ReadWhenAsked(readers))


def read_replica_info(path: Path) -> tuple[dict[int, str], dict[int, int]]:
    """The classes by id, and the class of each object (-1 = none)."""
    top = read_json(path)
    with reading(path, "Replica's classes ('id', 'name') and objects ('id', 'class_id')", "copy the file again"):
        names = {int(entry["id"]): str(entry["name"]) for entry in top["classes"]}
        of_object = {int(entry["id"]): int(entry["class_id"]) for entry in top["objects"]}
    if not names:
        raise ValueError(f"{path}: expected classes, got none; copy the file again")
    unknown = sorted({label for label in of_object.values() if label > 0 and label not in names})
    if unknown:
        raise ValueError(
            f"{path}: expected objects of its {len(names)} classes, got class {some([str(u) for u in unknown])}"
        )
    return names, {number: label if label in names else -1 for number, label in of_object.items()}


def _most_frequent(keys: Ids, values: Ids, count: int) -> Ids:  # [M], [M] -> [count]
    """The most frequent value of each key from 0 to count - 1; a tie goes to the lowest, -1 where there is none."""
    frequent = np.full(count, -1, np.int64)
    pairs, votes = np.unique(np.stack([keys, values], 1), axis=0, return_counts=True)
    order = np.lexsort((-pairs[:, 1], votes))  # written last: most votes, of equals the lowest value
    frequent[pairs[order, 0]] = pairs[order, 1]
    return frequent
