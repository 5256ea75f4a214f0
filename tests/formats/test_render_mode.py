"""Antialiased clouds and surfels stay what they are, or are named among what is lost."""

import json
import zipfile
from pathlib import Path

import numpy as np
import oracles_splat as oracle
import pytest
import torch
from cases_gltf import ply_columns, random_cloud

from kfgs import Gaussians
from kfgs.cameras import Camera
from kfgs.formats import read_splats, write_splats
from kfgs.formats.ply import read_header, write_ply
from kfgs.formats.render_mode import AS_FLAT, Mode, mode_from_comments, mode_from_meta, with_mode
from kfgs.formats.table import formats
from kfgs.splat import rasterize

WRITABLE = [name for name, module in formats().items() if hasattr(module, "write")]
HOLD_ANTIALIASED = ("compressed_ply", "ply", "spz", "sog")


def _splats(antialiased: bool = False) -> Gaussians:
    cloud = random_cloud(5, 0, antialiased=antialiased)
    return cloud.replace(sh=0.3 * cloud.sh)


def _through(folder, to, splats):
    """Written and read again: (what the words of loss are, what came back)."""
    suffix = formats()[to].SUFFIXES[0]
    written = write_splats(splats, folder / f"a{suffix}")
    return suffix, written.lost, read_splats(written.paths[0])


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("to", WRITABLE)
def test_antialiased_is_kept_or_named_and_a_plain_cloud_stays_plain(tmp_path, notes, to, antialiased):
    suffix, lost, back = _through(tmp_path, to, _splats(antialiased))
    kept = to in HOLD_ANTIALIASED or not antialiased
    assert back.antialiased is (antialiased and kept)
    assert lost == (() if kept else (f"antialiased rendering: {suffix} has no place for it",))
    assert notes == []


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_comments_are_those_that_others_look_for(tmp_path, suffix):
    for antialiased, comments in ((True, ["SplatRenderMode: mip", "antialiased 1"]), (False, [])):
        write_splats(_splats(antialiased), tmp_path / f"a{suffix}")
        assert read_header(tmp_path / f"a{suffix}").comments == ["written by kfgs", *comments]


def test_meta_has_the_keys_that_others_look_for(tmp_path):
    for antialiased, keys in ((True, {"antialias": True, "model": "antialiased"}), (False, {})):
        write_splats(_splats(antialiased), tmp_path / "a.sog")
        with zipfile.ZipFile(tmp_path / "a.sog") as archive:
            meta = json.loads(archive.read("meta.json"))
        assert {key: meta[key] for key in ("antialias", "model") if key in meta} == keys


@pytest.mark.parametrize(
    ("comments", "mode"),
    [
        (["Exported from Brush", "SH degree: 3", "SplatRenderMode: mip"], Mode(True)),
        (["SplatRenderMode: default"], Mode()),
        (["SplatRenderMode: 2dgs"], Mode(surfels=True)),
        (["Postshot v1.0.0", "postshot.anti_aliasing=1"], Mode(True)),
        (["postshot.anti_aliasing=0"], Mode()),
        (["antialiased 1"], Mode(True)),
        (["antialiased 0"], Mode()),
        (["  SPLATRENDERMODE:   MIP "], Mode(True)),
        (["antialiased 1", "SplatRenderMode: default"], Mode()),
        (["SplatRenderMode: default", "antialiased 1"], Mode(True)),
        (["SplatRenderMode: mip", "SplatRenderMode: 2dgs"], Mode(surfels=True)),
        (["SplatRenderMode: mip", "SplatRenderMode: 3dgut"], Mode(True, unknown=("SplatRenderMode: 3dgut",))),
        (["antialiased 2"], Mode(unknown=("antialiased 2",))),
        (["this scene is not antialiased 1", "antialiased", "SplatRenderMode:", ""], Mode()),
    ],
)
def test_comments_of_brush_and_postshot(comments, mode):
    assert mode_from_comments(comments) == mode


@pytest.mark.parametrize(
    ("meta", "mode"),
    [
        ({"antialias": True}, Mode(True)),
        ({"antialias": False}, Mode()),
        ({"model": "antialiased"}, Mode(True)),
        ({"model": "2dgs", "antialias": False}, Mode(surfels=True)),
        ({"model": "default", "antialias": True}, Mode()),
        ({"model": "3dgut", "antialias": True}, Mode(True, unknown=("model: '3dgut'",))),
        ({"model": ["antialiased"], "antialias": 1}, Mode(unknown=("model: ['antialiased']", "antialias: 1"))),
        ({}, Mode()),
    ],
)
def test_metas_of_both_spellings(meta, mode):
    assert mode_from_meta(meta) == mode


def _columns(count=4):
    return {name: values for name, values in ply_columns(count).items() if not name.startswith("scale")}


def test_unknown_modes_are_told(tmp_path, notes):
    columns = _columns() | {f"scale_{i}": np.full(4, -3.0, np.float32) for i in range(3)}
    write_ply(tmp_path / "a.ply", columns, comments=("SplatRenderMode: 3dgut",))
    splats = read_splats(tmp_path / "a.ply")
    assert not splats.antialiased
    assert len(notes) == 1
    assert "'SplatRenderMode: 3dgut'" in notes[0]


@pytest.mark.parametrize("comments", [(), ("SplatRenderMode: 2dgs",)])
def test_two_scales_are_surfels_without_thickness(tmp_path, notes, comments):
    columns = _columns() | {"scale_0": np.full(4, -3.0, np.float32), "scale_1": np.full(4, -2.0, np.float32)}
    if comments:  # some trainers keep a third scale that 2DGS does not use
        columns["scale_2"] = np.full(4, -1.0, np.float32)
    write_ply(tmp_path / "a.ply", columns, comments=comments)
    splats = read_splats(tmp_path / "a.ply")
    expected = np.exp([-3.0, -2.0, -3.0]) * [1, 1, 0.001]
    np.testing.assert_allclose(splats.scales.numpy(), np.tile(expected, (4, 1)), rtol=1e-6)
    assert notes == [f"a.ply: {AS_FLAT}"]
    write_splats(splats, tmp_path / "b.ply")
    again = read_splats(tmp_path / "b.ply")
    torch.testing.assert_close(again.scales, splats.scales)


@pytest.mark.parametrize(("tilt", "most"), [(0, 0.01), (30, 0.025), (75, 0.05)])
def test_surfels_drawn_as_flat_gaussians_are_nearly_those_of_2dgs(tilt, most):
    turn = np.deg2rad(tilt) / 2
    values = [0.1, -0.05, 3.0], [float(np.cos(turn)), 0.0, float(np.sin(turn)), 0.0]
    surfel = Gaussians(*(torch.tensor([v]) for v in values), torch.full((1, 3), 0.1), torch.tensor([0.8]))
    camera = Camera(torch.eye(4), torch.tensor([[250.0, 0, 30], [0, 250, 30], [0, 0, 1]]), 60, 60)
    drawn = rasterize(
        with_mode(Path("a"), surfel, Mode(surfels=True)).replace(features=torch.ones(1, 1)), camera, engine="reference"
    ).alpha.numpy()
    at = camera.viewmat.numpy(), camera.K.numpy().astype(float)
    R = range(60)
    expected = [[oracle.surfel_alpha(x + 0.5, y + 0.5, *values, [0.1, 0.1], 0.8, *at) for x in R] for y in R]
    assert np.abs(drawn - expected).max() < most
    assert drawn.max() > 0.7


def test_the_3d_filter_of_mip_splatting_is_applied_once(tmp_path):
    columns = _columns(2) | {f"scale_{i}": np.log(np.array([0.3, 0.4], np.float32)) for i in range(3)}
    columns |= {"opacity": np.zeros(2, np.float32), "filter_3D": np.array([0.4, 0.0], np.float32)}
    write_ply(tmp_path / "a.ply", columns)
    splats = read_splats(tmp_path / "a.ply")
    torch.testing.assert_close(splats.scales[:, 0], torch.tensor([0.5, 0.4]))  # 3, 4, 5
    torch.testing.assert_close(splats.opacities, torch.tensor([0.5 * 0.6**3, 0.5]))
    assert splats.antialiased
    write_splats(splats, tmp_path / "b.ply")
    again = read_splats(tmp_path / "b.ply")
    assert (again.antialiased, again.extra) == (True, {})
    torch.testing.assert_close(again.scales, splats.scales)
