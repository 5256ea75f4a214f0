import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.cameras import Camera
from kfgs.formats import read_splats
from kfgs.formats.ply import read_ply, write_ply
from kfgs.gaussians import Gaussians
from kfgs.labels import Selection, connected_parts
from kfgs.pipeline.attach import label_cloud, save_labelled
from kfgs.viz.films import WIDTH, write_parts

K = torch.tensor([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]])


def balls(*places):
    n = len(places)
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * n), torch.full((n, 3), 0.2)
    return Gaussians(torch.tensor(places), quats, scales, torch.full((n,), 0.99))


def cameras():
    """One looks along +z, the other along -z."""
    back = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    return [Camera(torch.eye(4), K, 80, 60, "front.png"), Camera(back, K, 80, 60, "back.png")]


def test_each_part_is_drawn_in_its_own_view(tmp_path):
    cloud = balls((0.0, 0, 2), (0.0, 0, -2), (9.0, 0, 0))
    selection = Selection.of(torch.tensor([True, True, False]), "by hand")
    views = cameras()
    parts = connected_parts(cloud, selection, views, distance=0.5)
    seen = []

    def under(camera):
        seen.append(camera.name)
        return np.full((camera.height, camera.width, 3), 120, np.uint8)

    path = write_parts(tmp_path / "a.png", cloud, parts, views, under, "ball")
    assert sorted(seen) == ["back.png", "front.png"]
    with Image.open(path) as picture:
        drawn = np.asarray(picture)
    assert abs(drawn.shape[1] - 2 * WIDTH) < 30
    middle = drawn.shape[0] // 2 + 10
    for center in (WIDTH // 2, 3 * WIDTH // 2):
        assert drawn[middle, center].tolist() == [120] * 3  # the part keeps its colour
    assert (drawn[middle, 20] > 200).all()
    assert write_parts(tmp_path / "b.png", cloud, connected_parts(cloud, selection), views, under, "ball") is None


def test_labels_are_written_and_carried_to_points(tmp_path):
    cloud = balls((0.0, 0, 0), (5.0, 0, 0)).replace(
        features=torch.eye(2), labels=torch.tensor([1, 0]), scores=torch.tensor([0.5, 0.75]), names=("wall", "chair")
    )
    save_labelled(tmp_path / "a.ply", cloud, rule="by hand")
    read = read_splats(tmp_path / "a.ply")
    assert (read.labels.tolist(), read.scores.tolist(), read.names) == ([1, 0], [0.5, 0.75], ("wall", "chair"))
    assert read.sh is not None  # other programs show the classes
    points = {"x": np.array([0.1, 5.0, 100.0], np.float32), "mine": np.arange(3, dtype=np.uint8)}
    points |= {name: np.zeros(3, np.float32) for name in "yz"}
    write_ply(tmp_path / "points.ply", points)
    moved, files = label_cloud(cloud, tmp_path / "points.ply", tmp_path / "labelled.ply", distance=1.0)
    columns = read_ply(tmp_path / "labelled.ply")
    assert columns["class_id"].tolist() == moved.labels.tolist() == [1, 0, -1]
    assert columns["mine"].tolist() == [0, 1, 2]
    assert {"red", "green", "blue"} <= set(columns)
    assert [file.name for file in files] == ["labelled.ply", "labelled.ply.classes.json"]


def test_labelled_points_are_a_ply(tmp_path):
    cloud = balls((0.0, 0, 0)).replace(labels=torch.tensor([0]), names=("wall",))
    points = {name: np.zeros(3, np.float32) for name in "xyz"}
    write_ply(tmp_path / "points.ply", points)
    with pytest.raises(ValueError, match=tells("out:", ".ply", "points.spz")):
        label_cloud(cloud, tmp_path / "points.ply", tmp_path / "points.spz")
