"""The similarity between two frames from cameras of the same names."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from messages import refused, tells
from oracles_cameras import align_similarity
from scipy.spatial.transform import Rotation

from kfgs.cameras import Camera
from kfgs.cameras.similarity import Similarity
from kfgs.scenes import SceneError
from kfgs.scenes.frames import align_by_cameras


def a_similarity(seed=0):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    return Similarity(float(rng.uniform(0.3, 4)), torch.from_numpy(rotation), torch.from_numpy(rng.normal(size=3)))


def camera_at(center, rotation, name):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(rotation)
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.as_tensor(center, dtype=torch.float64)
    K = torch.tensor([[50.0, 0, 31], [0, 52, 24], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, 64, 48, name)


def some_cameras(count=20, seed=0, centers=None):
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3)) if centers is None else centers
    turns = Rotation.random(len(centers), random_state=rng).as_matrix()
    return [camera_at(*place, f"view_{i}.png") for i, place in enumerate(zip(centers, turns, strict=True))]


def moved(cameras, similarity):
    return [similarity.apply_to_camera(camera) for camera in cameras]


def assert_same(found, true, tolerance=1e-6):
    torch.testing.assert_close(found.matrix(), true.matrix(), atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("seed", range(3))
def test_recovers_a_known_similarity(seed):
    cameras, true = some_cameras(seed=seed), a_similarity(seed)
    found = align_by_cameras(cameras, moved(cameras, true))
    assert_same(found.similarity, true)
    assert (found.inliers, found.count) == (20, 20)
    assert found.rms < 1e-9


def test_thirty_percent_of_wrong_poses_change_nothing():
    cameras, true = some_cameras(), a_similarity(1)
    others = [*moved(some_cameras(6, seed=9), true), *moved(cameras, true)[6:]]
    found = align_by_cameras(cameras, others)
    assert_same(found.similarity, true)
    assert found.inliers == 14
    assert sorted(found.left_out) == [f"view_{i}" for i in range(6)]


def test_noisy_centers_give_the_least_squares_fit():
    cameras, true = some_cameras(30), a_similarity(2)
    rng = np.random.default_rng(3)
    others = []
    for camera in moved(cameras, true):
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] += torch.from_numpy(0.002 * true.scale * rng.normal(size=3))
        others.append(replace(camera, viewmat=viewmat))
    found = align_by_cameras(cameras, others)
    assert found.inliers == 30
    src, dst = (torch.stack([camera.center for camera in side]).numpy() for side in (cameras, others))
    scale, rotation, translation = align_similarity(src, dst)
    assert found.similarity.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.similarity.rotation.numpy(), rotation, atol=1e-9)
    np.testing.assert_allclose(found.similarity.translation.numpy(), translation, atol=1e-9)
    rms = np.sqrt(((scale * src @ rotation.T + translation - dst) ** 2).sum(1).mean())
    assert found.rms == pytest.approx(rms, rel=1e-6)


def test_names_match_without_folder_and_suffix():
    cameras, true = some_cameras(), a_similarity()
    others = [replace(camera, name=f"images/{camera.name[:-4]}.JPG") for camera in moved(cameras, true)]
    assert_same(align_by_cameras(cameras, others[::-1]).similarity, true)


def test_folders_count_where_names_repeat_without_them():
    cameras, true = some_cameras(), a_similarity()
    cameras = [replace(c, name=f"{'ab'[i % 2]}/{i // 2}.png") for i, c in enumerate(cameras)]
    assert_same(align_by_cameras(cameras, moved(cameras, true)[::-1]).similarity, true)


@pytest.mark.parametrize("count", [2, 3, 8])
def test_cameras_on_a_line_use_their_orientations(count):
    line = np.outer(np.linspace(-1, 2, count), [1.0, 2.0, -1.0])
    cameras, true = some_cameras(centers=line), a_similarity(4)
    assert_same(align_by_cameras(cameras, moved(cameras, true)).similarity, true)


def test_a_line_with_wrong_poses():
    line = np.outer(np.linspace(-1, 2, 10), [1.0, 2.0, -1.0])
    cameras, true = some_cameras(centers=line), a_similarity(5)
    others = moved(cameras, true)
    others[3:6] = [replace(c, name=o.name) for c, o in zip(some_cameras(3, seed=8), others[3:6], strict=True)]
    found = align_by_cameras(cameras, others)
    assert_same(found.similarity, true)
    assert found.inliers == 7


def test_the_report_is_json():
    cameras = some_cameras()
    facts = json.loads(json.dumps(align_by_cameras(cameras, moved(cameras, a_similarity())).to_json()))
    assert facts["count"] == 20
    assert facts["left out"] == []
    np.testing.assert_allclose(facts["matrix"], a_similarity().matrix().numpy(), atol=1e-6)


def test_too_few_common_names_are_refused():
    cameras = some_cameras(5)
    others = [replace(camera, name=f"other_{i}") for i, camera in enumerate(cameras)]
    refused(lambda: align_by_cameras(cameras, others), "cameras:", "got 0", "view_0", "other_0", error=SceneError)


def test_cameras_at_one_place_have_no_scale():
    cameras = some_cameras(centers=np.ones((4, 3)))
    with pytest.raises(SceneError, match=tells("cameras:", "places", "got 4 at one")):
        align_by_cameras(cameras, moved(cameras, a_similarity()))


@pytest.mark.parametrize(
    ("count", "others"),
    [
        (20, lambda cameras: some_cameras(20, seed=1)),
        (
            18,
            lambda cameras: [cameras[(13 * i + 3) % 18] for i in range(18)],
        ),  # shuffled names: no two orientations agree
        (2, lambda cameras: cameras[::-1]),
    ],
)
def test_unrelated_poses_and_exchanged_names_are_refused(count, others):
    cameras = some_cameras(count)
    changed = moved(others(cameras), a_similarity())
    named = [replace(camera, name=f"view_{i}.png") for i, camera in enumerate(changed)]
    refused(lambda: align_by_cameras(cameras, named), "cameras:", count, "got 0", error=SceneError)


@pytest.mark.parametrize(("tripod", "elsewhere"), [(2, 1), (10, 8), (16, 4)])
@pytest.mark.parametrize("jitter", [0.0, 1e-3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_most_cameras_on_one_tripod_leave_a_scale(tripod, elsewhere, jitter, dtype):
    rng = np.random.default_rng(0)
    centers = np.concatenate([0.3 + jitter * rng.normal(size=(tripod, 3)), rng.normal(size=(elsewhere, 3))])
    cameras, true = some_cameras(centers=centers), a_similarity(7)
    others = moved(cameras, true)
    for i, camera in enumerate(others):
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] += torch.from_numpy(jitter * true.scale * rng.normal(size=3))
        others[i] = replace(camera, viewmat=viewmat)
    found = align_by_cameras(*([camera.to(dtype) for camera in side] for side in (cameras, others)))
    assert found.inliers == tripod + elsewhere
    assert_same(found.similarity, true, 1e-5 + 8 * jitter)
    assert found.size > 0.5 * true.scale  # of the cameras elsewhere, not of the tripod
