"""Labelled points: ScanNet and Replica, and the label pictures of Semantic-NeRF. Files are written here in their layouts."""

import json
from pathlib import Path

import numpy as np
import pytest
from meshes import QUADS, XYZ, write_mesh
from messages import refused, tells
from PIL import Image

from kfgs.evaluation import find_labels, find_points
from kfgs.evaluation.replica import load_replica_points, load_semantic_nerf_labels
from kfgs.evaluation.scannet import load_scannet_points
from kfgs.formats.ply import write_ply


def _vertices() -> dict[str, np.ndarray]:
    return {name: XYZ[:, i] for i, name in enumerate("xyz")}


def _scannet(folder: Path, labels: list[int]) -> Path:
    colors = {name: np.zeros(6, np.uint8) for name in ("red", "green", "blue", "alpha")}
    write_ply(
        folder / "scene0000_00_vh_clean_2.labels.ply", _vertices() | colors | {"label": np.array(labels, np.uint16)}
    )
    return folder


def test_scannet_points(tmp_path: Path) -> None:
    truth = load_scannet_points(_scannet(tmp_path, [0, 1, 1, 5, 28, 40]))
    assert truth.points.tolist() == XYZ.tolist()
    assert truth.labels.tolist() == [0, 1, 1, 5, 28, 40]
    assert (truth.names[1], truth.names[28]) == ("wall", "showercurtain")


def test_scannet_points_that_are_not_whole(tmp_path: Path) -> None:
    refused(lambda: load_scannet_points(tmp_path), tmp_path, "_vh_clean_2.labels.ply", "none", error=FileNotFoundError)
    _scannet(tmp_path, [0, 0, 0, 0, 0, 99])
    refused(lambda: load_scannet_points(tmp_path), "labels.ply", "NYU40 ids", "[0, 99]")
    write_ply(tmp_path / "mesh.ply", _vertices())
    refused(lambda: load_scannet_points(tmp_path / "mesh.ply"), "mesh.ply", "'label'", "x, y, z")


INFO = {
    "classes": [{"id": 20, "name": "chair"}, {"id": 80, "name": "table"}],
    "objects": [{"id": 4, "class_id": 80, "class_name": "table"}, {"id": 9, "class_id": -1, "class_name": ""}],
}


def _replica(folder: Path) -> Path:
    write_mesh(folder / "habitat/mesh_semantic.ply", QUADS)
    (folder / "habitat/info_semantic.json").write_text(json.dumps(INFO))
    return folder


def test_replica_points(tmp_path: Path) -> None:
    truth = load_replica_points(_replica(tmp_path))
    # faces of each vertex: 0: 4 9; 1: 4 9 9 4; 2: 4 9 4; 3: 4 9 4; 4: 9 9 4; 5: none. A tie goes to the lower object.
    assert truth.instances is not None
    assert truth.instances.tolist() == [4, 4, 4, 4, 9, -1]
    assert truth.labels.tolist() == [80, 80, 80, 80, -1, -1]
    assert truth.names == {20: "chair", 80: "table"}
    assert truth.points.tolist() == XYZ.tolist()
    assert len(load_replica_points(tmp_path / "habitat").points) == 6


def test_replica_points_that_are_not_whole(tmp_path: Path) -> None:
    refused(lambda: load_replica_points(tmp_path), "habitat/mesh_semantic.ply", error=FileNotFoundError)
    _replica(tmp_path)
    write_mesh(tmp_path / "habitat/mesh_semantic.ply", QUADS, extra=False)
    refused(lambda: load_replica_points(tmp_path), "mesh_semantic.ply", "'object_id'")
    write_mesh(tmp_path / "habitat/mesh_semantic.ply", [([0, 1, 77], 4)])
    refused(lambda: load_replica_points(tmp_path), "mesh_semantic.ply", "6 vertices", "77")
    write_mesh(tmp_path / "habitat/mesh_semantic.ply", QUADS)
    whole = (tmp_path / "habitat/mesh_semantic.ply").read_bytes()
    for cut in (1, 10, 30):
        (tmp_path / "habitat/mesh_semantic.ply").write_bytes(whole[:-cut])
        refused(lambda: load_replica_points(tmp_path), "mesh_semantic.ply")
    write_mesh(tmp_path / "habitat/mesh_semantic.ply", QUADS)
    broken = INFO | {"objects": [{"id": 4, "class_id": 81}]}
    (tmp_path / "habitat/info_semantic.json").write_text(json.dumps(broken))
    refused(lambda: load_replica_points(tmp_path), "info_semantic.json", "2 classes", "81")
    (tmp_path / "habitat/info_semantic.json").write_text("{}")
    refused(lambda: load_replica_points(tmp_path), "info_semantic.json", "classes")
    (tmp_path / "habitat/info_semantic.json").unlink()
    refused(lambda: load_replica_points(tmp_path), "info_semantic.json", error=FileNotFoundError)


def test_labels_of_semantic_nerf(tmp_path: Path) -> None:
    sequence = tmp_path / "room_0/Sequence_1"
    (sequence / "semantic_class").mkdir(parents=True)
    for i, ids in ((0, [[80, 0], [20, 99]]), (10, [[20, 20], [20, 20]])):
        Image.fromarray(np.array(ids, np.uint8)).save(sequence / f"semantic_class/semantic_class_{i}.png")
    refused(lambda: load_semantic_nerf_labels(sequence), "info_semantic.json", "info=PATH", error=FileNotFoundError)
    (tmp_path / "room_0/habitat").mkdir()
    (tmp_path / "room_0/habitat/info_semantic.json").write_text(json.dumps(INFO))
    truth = load_semantic_nerf_labels(sequence)
    assert truth.names == ("chair", "table")
    assert {stem: labels.tolist() for stem, labels in truth.maps.items()} == {
        "rgb_0": [[1, -1], [0, -1]],
        "rgb_10": [[0, 0], [0, 0]],
    }
    Image.new("RGB", (2, 2)).save(sequence / "semantic_class/semantic_class_0.png")
    refused(lambda: load_semantic_nerf_labels(sequence), "semantic_class_0.png", "one channel", "vis_")
    for file in (sequence / "semantic_class").iterdir():
        Image.new("L", (2, 2), 99).save(file)
    refused(lambda: load_semantic_nerf_labels(sequence), "semantic_class", "none of 2 pictures")
    refused(lambda: load_semantic_nerf_labels(tmp_path), "semantic_class_0.png", error=FileNotFoundError)


def test_points_and_labels_are_found_by_their_files(tmp_path: Path) -> None:
    scannet = _scannet(tmp_path / "scene0000_00", [0, 1, 1, 5, 28, 40])
    assert find_points(scannet).labels.tolist() == [0, 1, 1, 5, 28, 40]
    np.savez(tmp_path / "surface.npz", points=np.zeros((2, 3), np.float32), labels=np.array([1, 0], np.uint8))
    (tmp_path / "classes.json").write_text('["wall", "floor"]')
    found = find_points(tmp_path)
    assert (found.labels.tolist(), found.names) == ([1, 0], {0: "wall", 1: "floor"})
    (tmp_path / "surface.npz").write_bytes(b"no arrays")
    refused(lambda: find_points(tmp_path), "surface.npz", "'points' and 'labels'", "make the room again")
    with pytest.raises(FileNotFoundError, match=tells("truth", "labelled points", "mesh_semantic.ply", "not a folder")):
        find_points(tmp_path / "nowhere")
    refused(lambda: find_labels(tmp_path), "truth", "label pictures", "labels_scored/*.png", error=FileNotFoundError)
    for name, grey in (("labels", 0), ("labels_scored", 1)):
        (tmp_path / name).mkdir()
        Image.fromarray(np.full((2, 2), grey, np.uint8)).save(tmp_path / name / "a.png")
    assert find_labels(tmp_path).maps["a"].unique().tolist() == [1]  # the scored ones come first
    assert find_labels(tmp_path / "labels").maps["a"].unique().tolist() == [0]
    for name in ("labels", "labels_scored"):  # as photos in subfolders, from a camera that writes .PNG
        (tmp_path / name / "left").mkdir()
        (tmp_path / name / "a.png").rename(tmp_path / name / "left/a.PNG")
    assert list(find_labels(tmp_path).maps) == list(find_labels(tmp_path / "labels").maps) == ["left/a"]
