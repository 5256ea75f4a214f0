"""Antialiased clouds and surfels stay what they are, or are named among what is lost."""

import json
import zipfile

import pytest
import torch

from kfgs.formats import SplatFile, formats, read_splats, write_splats
from kfgs.formats.ply import read_comments
from kfgs.formats.render_mode import comments_of_mode, meta_of_mode, mode_from_comments, mode_from_meta
from kfgs.gaussians import Gaussians

WRITABLE = [name for name, module in formats().items() if hasattr(module, "write")]
HOLD_ANTIALIASED = ("compressed_ply", "ply", "spz", "sog")
HOLD_SURFELS = ("compressed_ply", "ply", "sog")


def _splats(**info) -> SplatFile:
    g = torch.Generator().manual_seed(2)
    cloud = Gaussians(
        means=torch.randn(5, 3, generator=g),
        quats=torch.randn(5, 4, generator=g),
        scales=torch.rand(5, 3, generator=g) + 0.1,
        opacities=torch.rand(5, generator=g),
        sh=torch.randn(5, 1, 3, generator=g) * 0.3,
    )
    return SplatFile(cloud, info=info)


def _through(folder, to, splats):
    """Written and read again: (what the words of loss are, what came back)."""
    suffix = formats()[to].SUFFIXES[0]
    written = write_splats(folder / f"a{suffix}", splats)
    return suffix, written.lost, read_splats(written.paths[0])


@pytest.mark.parametrize("to", WRITABLE)
def test_antialiased_is_kept_or_named(tmp_path, to):
    suffix, lost, back = _through(tmp_path, to, _splats(antialiased=True))
    if to in HOLD_ANTIALIASED:
        assert (lost, back.info["antialiased"]) == ((), True)
    else:
        assert lost == (f"antialiased rendering: {suffix} has no place for it",)
        assert "antialiased" not in back.info


@pytest.mark.parametrize("to", WRITABLE)
def test_surfels_are_kept_or_named(tmp_path, to):
    suffix, lost, back = _through(tmp_path, to, _splats(surfels=True))
    if to in HOLD_SURFELS:
        assert (lost, back.info["surfels"], "antialiased" in back.info) == ((), True, False)
    else:
        assert lost == (f"rendering as surfels (2DGS): {suffix} has no place for it",)
        assert "surfels" not in back.info


@pytest.mark.parametrize("to", WRITABLE)
def test_a_plain_cloud_stays_plain(tmp_path, to):
    for info in ({"antialiased": False}, {}):
        _, lost, back = _through(tmp_path, to, _splats(**info))
        assert lost == ()
        assert not back.info.get("antialiased")
        if to in HOLD_ANTIALIASED and (info or to == "spz"):
            assert back.info["antialiased"] is False
        else:
            assert "antialiased" not in back.info


def test_antialiased_goes_all_the_way_round(tmp_path):
    splats = _splats(antialiased=True)
    for i, suffix in enumerate((".spz", ".sog", ".compressed.ply", ".ply", ".spz")):
        write_splats(tmp_path / f"{i}{suffix}", splats)
        splats = read_splats(tmp_path / f"{i}{suffix}")
    assert splats.info["antialiased"] is True
    assert (tmp_path / "4.spz").read_bytes()[14] == 1  # the header's flags


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_comments_are_those_that_others_look_for(tmp_path, suffix):
    for info, comments in (
        ({"antialiased": True}, ["SplatRenderMode: mip", "antialiased 1"]),
        ({"antialiased": False}, ["SplatRenderMode: default", "antialiased 0"]),
        ({"surfels": True}, ["SplatRenderMode: 2dgs"]),
        ({}, []),
    ):
        write_splats(tmp_path / f"a{suffix}", _splats(**info))
        assert read_comments(tmp_path / f"a{suffix}") == ["written by kfgs", *comments]


def test_meta_has_the_keys_that_others_look_for(tmp_path):
    for info, keys in (
        ({"antialiased": True}, {"antialias": True, "model": "antialiased"}),
        ({"antialiased": False}, {"antialias": False}),
        ({"surfels": True}, {"model": "2dgs"}),
        ({}, {}),
    ):
        write_splats(tmp_path / "a.sog", _splats(**info))
        with zipfile.ZipFile(tmp_path / "a.sog") as archive:
            meta = json.loads(archive.read("meta.json"))
        assert {key: meta[key] for key in ("antialias", "model") if key in meta} == keys


@pytest.mark.parametrize(
    ("comments", "mode"),
    [
        (["Exported from Brush", "SH degree: 3", "SplatRenderMode: mip"], {"antialiased": True}),
        (["SplatRenderMode: default"], {"antialiased": False}),
        (["SplatRenderMode: 2dgs"], {"surfels": True}),
        (["Postshot v1.0.0", "postshot.anti_aliasing=1"], {"antialiased": True}),
        (["postshot.anti_aliasing=0"], {"antialiased": False}),
        (["antialiased 1"], {"antialiased": True}),
        (["antialiased 0"], {"antialiased": False}),
        (["  SPLATRENDERMODE:   MIP "], {"antialiased": True}),
        (["antialiased 1", "SplatRenderMode: default"], {"antialiased": False}),
        (["SplatRenderMode: default", "antialiased 1"], {"antialiased": True}),
        (["SplatRenderMode: mip", "SplatRenderMode: 2dgs"], {"surfels": True}),
        (["SplatRenderMode: mip", "SplatRenderMode: banana", "antialiased maybe"], {"antialiased": True}),
        (["this scene is not antialiased 1", "antialiased", "SplatRenderMode:", ""], {}),
    ],
)
def test_comments_of_brush_and_postshot(comments, mode):
    assert mode_from_comments(comments) == mode


@pytest.mark.parametrize(
    ("meta", "mode"),
    [
        ({"antialias": True}, {"antialiased": True}),
        ({"antialias": False}, {"antialiased": False}),
        ({"model": "antialiased"}, {"antialiased": True}),
        ({"model": "2dgs", "antialias": False}, {"surfels": True}),
        ({"model": "default", "antialias": True}, {"antialiased": False}),
        ({"model": "other", "antialias": True}, {"antialiased": True}),
        ({"model": ["antialiased"], "antialias": 1}, {}),
        ({}, {}),
    ],
)
def test_metas_of_both_spellings(meta, mode):
    assert mode_from_meta(meta) == mode


def test_a_mode_that_is_not_known_is_not_claimed():
    assert comments_of_mode({"antialiased": None}) == ()
    assert meta_of_mode({"antialiased": None}) == {}
