"""Colours in other columns, harmonics of degree 4, names in UTF-8, and what formats say that they lose."""

import json

import numpy as np
import pytest
import torch
from cases_clouds import balls
from cases_gltf import ply_columns

from kfgs.formats import read_splats, write_splats
from kfgs.formats.ply import read_header, write_ply

C0 = 0.28209479177387814


@pytest.mark.parametrize(("kind", "largest"), [("u1", 255), ("u2", 65535), ("f4", 1), ("f8", 255), ("i4", 255)])
def test_red_green_and_blue_are_colours(tmp_path, kind, largest):
    rgb = np.random.default_rng(1).random((50, 3)) * largest
    rgb = rgb if kind[0] == "f" else rgb.round()
    columns = ply_columns(50, base="") | {
        name: rgb[:, i].astype(kind) for i, name in enumerate(("red", "green", "blue"))
    }
    write_ply(tmp_path / "a.ply", columns)
    splats = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(splats.sh[:, 0] * C0 + 0.5, rgb / largest, atol=1e-6)
    assert splats.extra == {}
    assert write_splats(splats, tmp_path / "b.spz").lost == ()


def test_where_there_are_both_harmonics_count_and_the_others_are_kept(tmp_path):
    red = np.full(50, 7, "u1")
    columns = ply_columns(50) | {"red": red, "green": red, "blue": red}
    write_ply(tmp_path / "a.ply", columns)
    splats = read_splats(tmp_path / "a.ply")
    np.testing.assert_array_equal(splats.sh[:, 0, 1], columns["f_dc_1"])
    assert sorted(splats.extra) == ["blue", "green", "red"]
    rest = {name: values for name, values in columns.items() if name != "green" and name[:2] != "f_"}
    write_ply(tmp_path / "b.ply", rest)
    assert sorted(read_splats(tmp_path / "b.ply").extra) == ["blue", "red"]  # no colour


NOTE = "spherical harmonics of degree 4: read up to degree 3"


def test_degree_4_is_read_up_to_degree_3_and_noted(tmp_path, notes):
    columns = ply_columns(50, degree=4)
    write_ply(tmp_path / "a.ply", columns)
    splats = read_splats(tmp_path / "a.ply")
    assert notes[-1] == "a.ply: " + NOTE
    for channel in range(3):
        for k in range(15):
            np.testing.assert_array_equal(splats.sh[:, 1 + k, channel], columns[f"f_rest_{24 * channel + k}"])

    write_splats(splats, tmp_path / "a.gltf")
    root = json.loads((tmp_path / "a.gltf").read_text())
    attributes = root["meshes"][0]["primitives"][0]["attributes"]
    name = "KHR_gaussian_splatting:SH_DEGREE_{}_COEF_{}"
    attributes |= {name.format(4, i): attributes[name.format(0, 0)] for i in range(9)}
    (tmp_path / "b.gltf").write_text(json.dumps(root))
    back = read_splats(tmp_path / "b.gltf")
    assert notes[-1] == "b.gltf: " + NOTE
    assert torch.equal(back.sh, read_splats(tmp_path / "a.gltf").sh)

    g = splats
    values = {"means": g.means, "scales": g.scales.log(), "quats": g.quats, "opacities": g.opacities.logit()}
    values["sh0"] = g.sh[:, :1]
    torch.save({"splats": values | {"shN": torch.cat([g.sh[:, 1:], torch.ones(50, 9, 3)], 1)}}, tmp_path / "a.pt")
    back = read_splats(tmp_path / "a.pt")
    assert notes[-1] == "a.pt: " + NOTE
    assert torch.equal(back.sh, g.sh)


@pytest.mark.parametrize("coding", ["utf-8", "latin-1", "utf-8-sig"])
def test_names_and_comments_that_are_not_ascii(tmp_path, coding):
    write_ply(tmp_path / "a.ply", ply_columns(50) | {"größe": np.arange(50, dtype="f4")}, comments=("Büro",))
    content = (tmp_path / "a.ply").read_bytes()
    for word in ("größe", "Büro"):
        content = content.replace(word.encode(), word.encode(coding.replace("-sig", "")))
    (tmp_path / "b.ply").write_bytes((b"\xef\xbb\xbf" if coding == "utf-8-sig" else b"") + content)
    assert read_header(tmp_path / "b.ply").comments == ["Büro"]
    splats = read_splats(tmp_path / "b.ply")
    assert list(splats.extra) == ["größe"]
    assert write_splats(splats, tmp_path / "c.ply").lost == ()
    assert read_splats(tmp_path / "c.ply").extra["größe"].tolist() == list(range(50))
    assert "größe" in " ".join(write_splats(splats, tmp_path / "c.splat").lost)


def test_names_that_a_ply_cannot_have_are_dropped_in_words(tmp_path):
    write_ply(tmp_path / "a.ply", ply_columns(50) | {"mine": np.arange(50, dtype="f4")})
    splats = read_splats(tmp_path / "a.ply")
    splats = splats.replace(extra=dict.fromkeys(("my column", "x", "ok"), splats.extra["mine"]))
    assert write_splats(splats, tmp_path / "b.ply").lost == ("the columns my column, x: .ply has no place for them",)
    back = read_splats(tmp_path / "b.ply")
    assert list(back.extra) == ["ok"]
    assert torch.equal(back.means, splats.means)


def _wide(far):
    g = torch.Generator().manual_seed(6)
    cloud = balls(torch.randn(600, 3, generator=g), scale=0.02, opacity=0.5, sh=torch.zeros(600, 1, 3))
    cloud.means[77] = far
    return cloud


@pytest.mark.parametrize(("name", "far"), [("a.compressed.ply", 1e4), ("a.spz", 1e6)])
def test_a_far_gaussian_that_makes_the_others_coarse_is_told(tmp_path, name, far):
    assert write_splats(_wide(1.0), tmp_path / name).lost == ()
    splats = _wide(far)
    written = write_splats(splats, tmp_path / name)
    (lost,) = written.lost
    order = torch.arange(600) if written.order is None else written.order
    off = (read_splats(tmp_path / name).means - splats.means[order]).norm(dim=1)
    off[order == 77] = 0
    moved = int((off > 2 * 0.02).sum())
    assert moved > 50
    assert int(lost.split()[2].replace(",", "")) >= moved  # what may move, of which most do
    for exact in (".ply", ".glb"):  # the advice
        assert exact in lost
        assert write_splats(splats, tmp_path / f"b{exact}").lost == ()
        assert (read_splats(tmp_path / f"b{exact}").means - splats.means).abs().max() == 0


def test_one_bright_colour_that_makes_the_others_coarse_is_told(tmp_path):
    splats = _wide(1.0)
    splats.sh[77] = 1e3  # in the last chunk: 600 - 2 * 256 = 88
    (lost,) = write_splats(splats, tmp_path / "a.compressed.ply").lost
    assert lost.startswith("base colours of 88 Gaussians")
