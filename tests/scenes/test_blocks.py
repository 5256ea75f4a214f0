"""Blocks: cores fill space without overlap, the views that see a core are found, and nothing that hides it is missing."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from messages import refused

from kfgs.scenes import SceneError, load_scene
from kfgs.scenes.blocks import Block, partition, write_part
from kfgs.scenes.colmap_model import read_model


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_every_point_of_space_lies_in_one_core(room, count):
    blocks = partition(read_model(room / "sparse/0"), count)
    points = np.concatenate([np.random.default_rng(0).normal(0, 50, (500, 3)), read_model(room / "sparse/0").points])
    assert len(blocks) == count
    assert (sum(block.holds(points).astype(int) for block in blocks) == 1).all()


def test_points_are_shared_evenly_and_outliers_do_not_count(room):
    points = read_model(room / "sparse/0").points
    blocks = partition(read_model(room / "sparse/0"), 4)
    counts = [int(block.holds(points).sum()) for block in blocks]
    assert max(counts) < 1.2 * min(counts)
    assert np.ptp([block.reach for block in blocks]) < 20  # the room is 6 m long, its outliers lie 100 m away


def test_views_are_those_whose_tracks_lie_in_the_core(room):
    model = read_model(room / "sparse/0")
    rows = {int(number): row for row, number in enumerate(model.point_ids)}
    for block in partition(model, 3):
        inside = block.holds(model.points)
        seen = {i.name: inside[[rows[int(k)] for k in i.observed if k >= 0]].mean() for i in model.images.values()}
        assert set(block.views) == {name for name, share in seen.items() if share >= 0.01}


def test_what_stands_between_a_camera_and_the_core_is_needed(room):
    scene = load_scene(room)
    centers = {camera.name: camera.center.numpy() for camera in scene.cameras}
    points = read_model(room / "sparse/0").points
    for block in partition(read_model(room / "sparse/0"), 4):
        core = points[block.holds(points)]
        core = core[np.abs(core).max(1) < 8]  # without outliers
        for name in block.views:
            between = centers[name] + np.linspace(0, 1, 9)[:, None, None] * (core - centers[name])
            needed = block.needs(between.reshape(-1, 3), np.zeros(between.size // 3))
            assert needed.mean() > 0.97  # robust_bounds leaves 2 % out
    assert block.needs(np.array([[1000.0, 1000, 1000]]), np.zeros(1)) == block.holds(np.array([[1000.0, 1000, 1000]]))


def test_a_block_survives_json(room):
    for block in partition(read_model(room / "sparse/0"), 3):
        assert Block(**json.loads(json.dumps(asdict(block), allow_nan=False))) == block


def test_a_part_of_a_model_is_a_model(room, tmp_path):
    model = read_model(room / "sparse/0")
    views = partition(model, 4)[1].views[:4]
    write_part(tmp_path / "part", model, views)
    whole, part = load_scene(room), read_model(tmp_path / "part")
    counts = np.unique(
        np.concatenate([i.observed for i in model.images.values() if i.name in views]), return_counts=True
    )
    assert part.point_ids.tolist() == [i for i, n in zip(*counts, strict=True) if i >= 0 and n > 1]
    rows = np.searchsorted(model.point_ids, part.point_ids)
    assert np.array_equal(part.points, model.points[rows])
    assert np.array_equal(part.colors, model.colors[rows])
    assert {image.name for image in part.images.values()} == set(views)
    poses = {image.name: image.pose for image in part.images.values()}
    for camera in whole.cameras:
        if camera.name in poses:
            np.testing.assert_allclose(poses[camera.name], camera.viewmat.numpy(), atol=1e-6)


def test_what_cannot_be_cut(room, tmp_path):
    refused(lambda: partition(read_model(room / "sparse/0"), 10_000), "count", "fewer", error=SceneError)
    refused(lambda: partition(read_model(room / "sparse/0"), 0), "count", "0")
    model = read_model(room / "sparse/0")
    for image in model.images.values():
        image.observed[:] = -1
    refused(lambda: partition(model, 2), "model", "see", error=SceneError)
