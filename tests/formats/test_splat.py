import numpy as np
import torch
from cases_gltf import random_cloud
from oracles_precision import rotation_angles

from kfgs.formats import read_splats
from kfgs.formats.splat import read, write


def test_a_record_by_hand(tmp_path):
    bytes_ = np.float32([1.5, -2, 3, 0.1, 0.2, 0.4]).tobytes() + bytes([0, 255, 102, 51, 128, 192, 64, 0])
    (tmp_path / "a.splat").write_bytes(bytes_)
    g = read(tmp_path / "a.splat")
    np.testing.assert_array_equal(g.means, np.float32([[1.5, -2, 3]]))
    np.testing.assert_array_equal(g.scales, np.float32([[0.1, 0.2, 0.4]]))
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * g.sh[0, 0], [0, 1, 0.4], atol=1e-6)
    np.testing.assert_allclose(g.opacities, [0.2])
    quat = np.array([[0, 0.5, -0.5, -1]])  # w, x, y, z
    assert rotation_angles(g.quats.numpy(), quat).max() < 1e-3
    assert rotation_angles(g.quats.numpy(), quat[:, [3, 0, 1, 2]]).max() > 0.5  # read as x, y, z, w it is another


def test_rotations_about_an_axis_are_exact(tmp_path):
    cloud = random_cloud(8, 0).replace(quats=torch.cat([torch.eye(4), -torch.eye(4)]) * 3)
    write(tmp_path / "a.splat", cloud)
    assert rotation_angles(read(tmp_path / "a.splat").quats.numpy(), cloud.quats.numpy()).max() == 0
    stored = np.fromfile(tmp_path / "a.splat", np.uint8).reshape(8, 32)[:, 28:]
    assert set(stored.ravel()) == {0, 128}  # -1 has a byte, +1 has none: a viewer that does not normalise is right too


def test_an_empty_file_is_an_empty_cloud(tmp_path):
    write(tmp_path / "a.splat", random_cloud(0, 0))
    assert (tmp_path / "a.splat").read_bytes() == b""
    assert read(tmp_path / "a.splat").sh.shape == (0, 1, 3)


def test_degenerate_values_are_mended(tmp_path):
    (tmp_path / "a.splat").write_bytes(bytes(24) + bytes([9, 9, 9, 9]) + b"\x80" * 4)
    g = read_splats(tmp_path / "a.splat")
    assert g.quats.tolist() == [[1, 0, 0, 0]]
    assert bool((g.scales == 1e-10).all())
