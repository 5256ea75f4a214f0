import gsply
import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from messages import refused
from oracles_packed import compressed_gaussian
from oracles_precision import assert_within, precision, rotation_angles

from kfgs import Gaussians
from kfgs.formats import read_splats, write_splats
from kfgs.formats.compressed_ply import read, write
from kfgs.formats.ply import read_ply_elements, write_ply_elements


def _cloud(n: int = 700, degree: int = 3) -> Gaussians:
    cloud = random_cloud(n, degree)
    means, scales = cloud.means * torch.tensor([1.0, 5.0, 0.2]) + 3, (4 * cloud.scales - 5).exp()
    return cloud.replace(means=means, quats=3 * cloud.quats, scales=scales, sh=cloud.sh.clamp(-4, 4))


def _assert_read_as_the_oracle_does(path, rows):
    elements, cloud = read_ply_elements(path), read(path)
    for i in rows:
        for name, expected in compressed_gaussian(elements, i).items():
            np.testing.assert_allclose(getattr(cloud, name)[i].numpy(), expected, rtol=4e-6, atol=4e-6, err_msg=name)


@pytest.mark.parametrize("name", ["biker", "guitar"])
def test_real_files_are_read_as_others_do(shared_data, name):
    path = shared_data / "splats" / f"{name}.compressed.ply"
    ours, other = read_splats(path), gsply.plyread(str(path))
    assert len(ours) == {"biker": 152746, "guitar": 90854}[name]
    np.testing.assert_allclose(ours.means.numpy(), other.means, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours.scales.numpy(), np.exp(other.scales), rtol=4e-6)
    assert rotation_angles(ours.quats.numpy(), other.quats).max() < 1e-5
    np.testing.assert_allclose(ours.sh[:, 0].numpy(), other.sh0, rtol=0, atol=1e-6)
    # gsply gives opacities 0 and 1 the logits -10 and 10
    np.testing.assert_allclose(ours.opacities.numpy(), 1 / (1 + np.exp(-other.opacities)), rtol=0, atol=5e-5)
    _assert_read_as_the_oracle_does(path, [0, 255, 256, 40000, len(ours) - 1])


@pytest.mark.parametrize("name", ["biker", "guitar"])
def test_a_file_of_supersplat_is_written_as_it_was(tmp_path, shared_data, name):
    path = shared_data / "splats" / f"{name}.compressed.ply"
    write(tmp_path / "a.compressed.ply", read(path))  # in its own order
    before, after = (read_ply_elements(file) for file in (path, tmp_path / "a.compressed.ply"))
    for word in ("packed_position", "packed_scale", "packed_color"):
        np.testing.assert_array_equal(after["vertex"][word], before["vertex"][word])
    same = after["vertex"]["packed_rotation"] == before["vertex"]["packed_rotation"]
    assert same.mean() > 0.997  # which of two equal components is the largest
    assert list(after["chunk"]) == list(before["chunk"])
    for bound, column in before["chunk"].items():
        np.testing.assert_allclose(after["chunk"][bound], column, rtol=0, atol=2e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_made_clouds_survive_and_others_read_them(tmp_path, degree):
    cloud = _cloud(degree=degree)
    path = tmp_path / "a.compressed.ply"
    written = write_splats(cloud, path)
    order, stated, back = written.order, precision("compressed_ply", cloud), read(path)
    assert written.lost == ()
    assert_within(back, cloud.select(order), stated._replace(means=stated.means[order]))
    _assert_read_as_the_oracle_does(path, [0, 300, 699])
    other = gsply.plyread(str(path))
    np.testing.assert_allclose(other.means, back.means.numpy(), rtol=0, atol=2e-6)
    assert rotation_angles(other.quats, back.quats.numpy()).max() < 1e-5
    np.testing.assert_allclose(other.sh0, back.sh[:, 0].numpy(), rtol=0, atol=2e-6)
    if degree:  # gsply reads the outermost bytes as the middles of their steps, 1/64 from the ends
        np.testing.assert_allclose(other.shN, back.sh[:, 1:].numpy(), rtol=0, atol=1 / 64 + 1e-6)
        inner = np.abs(other.shN) < 3.96
        np.testing.assert_allclose(other.shN[inner], back.sh[:, 1:].numpy()[inner], rtol=0, atol=1e-6)


def test_a_file_without_colour_bounds(tmp_path):
    write(tmp_path / "a.compressed.ply", _cloud(300, 0))
    elements = read_ply_elements(tmp_path / "a.compressed.ply")
    for name in ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b"):
        del elements["chunk"][name]
    elements["vertex"]["packed_color"][0] = 0xFF800033
    write_ply_elements(tmp_path / "b.compressed.ply", elements)
    cloud = read(tmp_path / "b.compressed.ply")
    rgb = cloud.sh[0, 0] * 0.28209479 + 0.5
    torch.testing.assert_close(rgb, torch.tensor([1.0, 128 / 255, 0.0]))
    assert cloud.opacities[0] == torch.tensor(51 / 255)
    _assert_read_as_the_oracle_does(tmp_path / "b.compressed.ply", [0, 299])


def test_closed_form_of_one_gaussian(tmp_path):
    one = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0], [3.0, 4.0, 7.0]]),
        quats=torch.tensor([[2.0, 0, 0, 0], [0.0, 0, -1, 1]]),
        scales=torch.tensor([[1.0, 1, 1], [2.0, 2, 2]]),
        opacities=torch.tensor([1.0, 0.2]),
        sh=torch.zeros(2, 1, 3),
    )
    write(tmp_path / "a.compressed.ply", one)
    vertex = read_ply_elements(tmp_path / "a.compressed.ply")["vertex"]
    assert vertex["packed_position"].tolist() == [0, 2**32 - 1]
    assert vertex["packed_scale"].tolist() == [0, 2**32 - 1]
    assert vertex["packed_color"].tolist() == [255, 51]
    half = round(1023 / 2)
    assert vertex["packed_rotation"][0] == half << 20 | half << 10 | half  # w is the largest: index 0
    assert vertex["packed_rotation"][1] == 2 << 30 | half << 20 | half << 10 | 0  # y before z, turned to be positive
    back = read(tmp_path / "a.compressed.ply")
    torch.testing.assert_close(back.means, one.means)
    torch.testing.assert_close(back.scales, one.scales)


def test_what_lies_beyond_the_ranges_is_told(tmp_path):
    cloud = _cloud(20, 1)
    scales, sh = cloud.scales.clone(), cloud.sh.clone()
    scales[3, 1], sh[4, 2, 0], sh[4, 3, 1] = 1e-12, 9.0, -5.0
    odd = cloud.replace(scales=scales, sh=sh, features=torch.zeros(20, 4)).replace(extra={"id": np.arange(20)})
    written = write_splats(odd, tmp_path / "a.compressed.ply")
    assert written.lost == (
        "4 features per Gaussian: .compressed.ply has no place for them",
        "the columns id: .compressed.ply has no place for them",
        "scales of 1 of 20 Gaussians beyond what .compressed.ply holds: cut off",
        "higher harmonics of 1 of 20 Gaussians beyond what .compressed.ply holds: cut off",
    )
    order, stated = written.order, precision("compressed_ply", odd)
    assert stated.sh_rest >= 5
    back = read(tmp_path / "a.compressed.ply")
    assert_within(back, odd.select(order), stated._replace(means=stated.means[order]))


DAMAGE = {
    "chunks": lambda e: e["chunk"].update({name: column[:-1] for name, column in e["chunk"].items()}),
    "column": lambda e: e["chunk"].pop("min_scale_z"),
    "type": lambda e: e["chunk"].update(min_x=e["chunk"]["min_x"].astype(np.float64)),
    "colour": lambda e: e["chunk"].pop("max_b"),
    "packed": lambda e: e["vertex"].update(packed_scale=e["vertex"]["packed_scale"].astype(np.int32)),
    "sh rows": lambda e: e["sh"].update({name: column[1:] for name, column in e["sh"].items()}),
    "sh columns": lambda e: e["sh"].pop("f_rest_3"),
    "sh type": lambda e: e["sh"].update(f_rest_3=e["sh"]["f_rest_3"].astype(np.float32)),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_damaged_files_are_named(tmp_path, what):
    write(tmp_path / "a.compressed.ply", _cloud(600, 1))
    elements = read_ply_elements(tmp_path / "a.compressed.ply")
    DAMAGE[what](elements)
    write_ply_elements(tmp_path / "bad.ply", elements)
    refused(lambda: read_splats(tmp_path / "bad.ply"), "bad.ply: expected")
