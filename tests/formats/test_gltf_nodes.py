"""Where the nodes of a glTF scene put Gaussians: numbers by hand, and what a camera that moves along sees."""

import json

import numpy as np
import pytest
import torch
from cases_gltf import bent_gltf, random_cloud
from messages import refused
from scipy.spatial.transform import Rotation

from kfgs.cameras import Camera, Similarity
from kfgs.formats import read_splats
from kfgs.splat import rasterize


def test_a_node_moves_resizes_and_turns(tmp_path):
    cloud = random_cloud(5, 0)
    R = Rotation.from_euler("xyz", [20, -50, 100], degrees=True)
    node = {"mesh": 0, "rotation": R.as_quat().tolist(), "scale": [2, 2, 2], "translation": [1, 2, 3]}
    above = {"children": [1], "translation": [10, 0, 0]}
    path = bent_gltf(tmp_path, cloud, **{"nodes": [above, node]})
    g = read_splats(path)
    S = np.array([1.0, -1.0, -1.0])
    expected = (2 * R.apply(cloud.means.double().numpy() * S) + [11, 2, 3]) * S
    np.testing.assert_allclose(g.means.numpy(), expected, atol=1e-5)
    torch.testing.assert_close(g.scales, 2 * cloud.scales)
    for i in range(5):
        old = Rotation.from_quat(cloud.quats[i, [1, 2, 3, 0]].numpy()).as_matrix()
        expected_axes = np.diag(S) @ R.as_matrix() @ np.diag(S) @ old
        axes = Rotation.from_quat(g.quats[i, [1, 2, 3, 0]].numpy()).as_matrix()
        np.testing.assert_allclose(np.abs(np.sum(axes * expected_axes, 0)), 1, atol=1e-5)  # same axes up to sign


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_node_looks_the_same_from_a_moved_camera(tmp_path, degree):
    cloud = random_cloud(30, degree)
    R = Rotation.from_euler("xyz", [25, -65, 110], degrees=True).as_matrix()
    turn = Rotation.from_matrix(R).as_quat().tolist()
    node = {"mesh": 0, "translation": [1, 2, 3], "scale": [1.5] * 3, "rotation": turn}
    moved = read_splats(bent_gltf(tmp_path, cloud, **{"nodes": [node]}))
    S = np.diag([1.0, -1.0, -1.0])  # glTF's axes against ours
    motion = Similarity(1.5, torch.from_numpy(S @ R @ S), torch.tensor([1.0, -2.0, -3.0]))
    viewmat = torch.eye(4)
    viewmat[2, 3] = 6.0
    camera = Camera(viewmat, torch.tensor([[40.0, 0, 20], [0, 44, 14], [0, 0, 1]]), 36, 30)
    before, after = rasterize(cloud, camera).map, rasterize(moved, motion.apply_to_camera(camera)).map
    assert before.std() > 0.1
    torch.testing.assert_close(after, before, rtol=0, atol=2e-4)  # float32 all the way, up to 30 Gaussians a pixel


def test_a_node_that_moves_beyond_float32_is_named(tmp_path):
    path = bent_gltf(tmp_path, random_cloud(5, 0), **{"nodes/0/scale": [1e25] * 3, "nodes/0/translation": [1e29, 0, 0]})
    assert read_splats(path).means.isfinite().all()
    root = json.loads(path.read_text())
    root["nodes"] = [{"children": [1], "scale": [1e25] * 3}, root["nodes"][0]]
    root["scenes"][0]["nodes"] = [0]
    path.write_text(json.dumps(root))
    refused(lambda: read_splats(path), "bent.gltf:", "5 of 5", "infinity")
