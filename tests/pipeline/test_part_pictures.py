import dataclasses

import numpy as np
import torch
from kfgs.viz.shows import Photos
from PIL import Image
from small_room import make_room

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.labels import Selection, connected_parts
from kfgs.pipeline.part_pictures import WIDTH, write_parts
from kfgs.scenes import load_scene

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


def test_photographs_are_found_by_name(tmp_path):
    scene = load_scene(make_room(tmp_path / "scene"))
    view = scene.views("test")[0]
    camera = scene.cameras[view]
    np.testing.assert_allclose(Photos(scene)(camera), scene.image(view) * 255, atol=1)
    assert (Photos(scene)(dataclasses.replace(camera, name="other.png")) == 200).all()
