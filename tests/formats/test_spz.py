import gzip
import struct

import gsply
import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from messages import refused
from oracles_precision import assert_within, precision, rotation_angles
from oracles_spz import legacy_payload, smallest_three

from kfgs import Gaussians
from kfgs.formats import read_splats, write_splats
from kfgs.formats.spz import choose_fractional_bits, read, write

ROW = {"position": (256, -512, 768), "alpha": 51, "color": (0, 128, 255), "scale": (160, 128, 96)}
TURN = torch.tensor([1.0, -1.0, -1.0])


def _cloud(n: int = 40, degree: int = 3) -> Gaussians:
    cloud = random_cloud(n, degree)
    return cloud.replace(means=cloud.means * torch.tensor([3.0, 1.0, 0.5]), sh=0.8 * cloud.sh.tanh())


def _legacy(path, rows, packed=True, **options):
    data = legacy_payload(rows, **options)
    path.write_bytes(gzip.compress(data) if packed else data)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_cloud_comes_back_as_exactly_as_stated(tmp_path, degree):
    cloud = _cloud(degree=degree)
    assert write(tmp_path / "a.spz", cloud) == []
    back = read(tmp_path / "a.spz")
    assert_within(back, cloud, precision("spz", cloud))


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_old_versions_by_hand(tmp_path, version, packed):
    rotation = (191, 64, 200) if version < 3 else (2 << 30) | (100 << 20) | ((512 + 200) << 10) | 300
    position = (1.5, -0.25, 1000.0) if version == 1 else ROW["position"]
    sh = list(range(0, 72, 8))  # degree 1: y, z, x, each red, green, blue
    rows = [ROW | {"position": position, "rotation": rotation, "sh": sh}] * 2
    g = read(_legacy(tmp_path / "a.spz", rows, packed, version=version, degree=1, bits=8))
    raw = position if version == 1 else [value / 256 for value in position]
    np.testing.assert_allclose(g.means[1], [raw[0], -raw[1], -raw[2]])
    np.testing.assert_allclose(g.opacities[1], 0.2)
    np.testing.assert_allclose(g.scales[1], np.exp([0.0, -2.0, -4.0]), rtol=1e-6)
    np.testing.assert_allclose(g.sh[1, 0], [-0.5 / 0.15, (128 / 255 - 0.5) / 0.15, 0.5 / 0.15], atol=1e-6)
    stored = (np.array(sh).reshape(3, 3) - 128) / 128
    np.testing.assert_allclose(g.sh[1, 1:], stored * np.array([[-1], [-1], [1]]))  # y, z turn their signs, x does not
    if version < 3:
        x, y, z = (byte / 127.5 - 1 for byte in rotation)
        quat = [max(0.0, 1 - x * x - y * y - z * z) ** 0.5, x, -y, -z]
    else:
        x, y, z, w = smallest_three(rotation)
        quat = [w, x, -y, -z]
    assert rotation_angles(g.quats[1:].numpy(), np.array([quat])).max() < 1e-3
    assert abs(quat[3]) > 0.4  # a turned axis cannot hide


def test_biker_agrees_with_the_compressed_ply_of_the_same_scene(shared_data):
    ours = read_splats(shared_data / "splats" / "biker.spz")
    other = gsply.plyread(str(shared_data / "splats" / "biker.compressed.ply"))  # axes of the PLY
    assert len(ours) == len(other.means) == 152746
    assert np.abs(ours.means.numpy() - other.means).max() < 4e-3  # 11 bits over a chunk against 12 after the point
    logs = other.scales.clip(-10, None)
    assert np.abs(ours.scales.log().numpy() - logs).max() < 1 / 32 + 0.01
    angles = rotation_angles(ours.quats.numpy(), other.quats)
    assert np.quantile(angles, 0.999) < 0.01
    assert np.abs(ours.opacities.numpy() - 1 / (1 + np.exp(-other.opacities))).max() < 0.005
    assert np.abs(ours.sh[:, 0].numpy() - other.sh0).max() < 0.03


def test_fixtures_hold_four_splats(shared_data):
    expected = read_splats(shared_data / "splats" / "minimal.splat")
    for name in ("minimal-v3.spz", "minimal-v4.spz"):
        g = read_splats(shared_data / "splats" / name)
        torch.testing.assert_close(g.means, expected.means)
        torch.testing.assert_close(g.scales, expected.scales, rtol=0.02, atol=0)
        torch.testing.assert_close(g.opacities, expected.opacities)
        torch.testing.assert_close(g.sh, expected.sh, rtol=0, atol=0.02)
    plain, packed = (read(shared_data / "splats" / name) for name in ("minimal-raw.spz", "minimal-v2.spz"))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(plain, name), getattr(packed, name), rtol=0, atol=0)
    torch.testing.assert_close(packed.means * TURN, expected.means)  # made without turning the axes


@pytest.mark.parametrize(("value", "signs"), [(0, (1, -1, -1)), (4, (1, -1, -1)), (6, (1, 1, 1)), (7, (-1, -1, 1))])
def test_the_axes_of_adobes_record_are_obeyed(tmp_path, value, signs):
    record = struct.pack("<III", 0xADBE0003, 4, value)
    rows = [ROW | {"rotation": 0xC0000000}]
    path = _legacy(tmp_path / "a.spz", rows, version=3, bits=8, flags=2, extensions=record)
    np.testing.assert_array_equal(read(path).means[0], np.array([1, -2, 3]) * signs)


def test_antialiasing_is_kept(tmp_path):
    splats = _cloud().replace(antialiased=True)
    write(tmp_path / "a.spz", splats)
    assert read(tmp_path / "a.spz").antialiased
    assert (tmp_path / "a.spz").read_bytes()[14] == 1


def test_harmonics_of_degree_4_are_cut_and_told(tmp_path, notes):
    rows = [ROW | {"rotation": 0xC0000000, "sh": [128 + i for i in range(72)]}]
    splats = read(_legacy(tmp_path / "a.spz", rows, version=3, degree=4))
    assert splats.sh.shape == (1, 16, 3)
    assert splats.sh[0, 15, 2] == 44 / 128  # x (x^2 - 3 y^2) keeps its sign
    assert "spherical harmonics of degree 4: read up to degree 3" in notes[0]


def test_empty_clouds_survive(tmp_path):
    for degree in (0, 3):
        write(tmp_path / "a.spz", _cloud(0, degree))
        assert read(tmp_path / "a.spz").sh.shape == (0, (degree + 1) ** 2, 3)


def test_positions_get_the_bits_that_their_extent_leaves():
    for reach, bits in ((5.0, 12), (2047.9, 12), (2048.0, 11), (3e5, 4), (8e6, 0), (0.9, 15), (1e-9, 20), (0.0, 12)):
        means = torch.tensor([[0.0, -reach, 0.0]], dtype=torch.float64)
        assert choose_fractional_bits(means) == bits, reach
        assert round(reach * 2**bits) < 2**23
    assert choose_fractional_bits(torch.zeros(0, 3)) == 12


def test_what_is_lost_is_said(tmp_path):
    cloud = _cloud().replace(features=torch.zeros(40, 9))
    cloud.scales[3, 0] = 1e-7
    cloud.sh[5, 0, 1] = 5.0
    splats = cloud.replace(extra={"height": np.zeros(40), "score": np.zeros(40)})
    lost = write_splats(splats, tmp_path / "a.spz").lost
    assert any("9 features per Gaussian: .spz has no place" in words for words in lost)
    assert any("the columns height, score" in words for words in lost)  # a score without labels is a column
    assert any("scales of 1 of 40 Gaussians beyond what .spz holds" in words for words in lost)
    back, stated = read(tmp_path / "a.spz"), precision("spz", cloud)
    assert stated.scales > 400
    assert stated.sh0 == pytest.approx(5 - 0.5 / 0.15, rel=1e-3)
    assert_within(back, cloud, stated)


def test_a_cloud_that_is_too_wide_is_named(tmp_path):
    cloud = _cloud()
    refused(lambda: write_splats(cloud.replace(means=cloud.means * 1e9), tmp_path / "a.spz"), "means:", "8.38861e+06")
    assert list(tmp_path.iterdir()) == []
