import json

import numpy as np
import pytest
import torch

import kfgs
from kfgs import SemanticField, read_splats
from kfgs.cli import main
from kfgs.cli.options import Settings, Views
from kfgs.formats.ply import read_header, read_ply, write_ply


def test_attach_carries_classes_to_points_and_keeps_their_columns(desk, room, tmp_path):
    surface = np.load(room / "surface.npz")["points"].astype(np.float32)
    cloud = {name: np.ascontiguousarray(surface[:, i]) for i, name in enumerate("xyz")}
    red = np.full(len(surface), 200, np.uint8)
    columns = cloud | {"mass": np.arange(len(surface), dtype=np.float32), "red": red, "green": red, "blue": red}
    write_ply(tmp_path / "cloud.ply", columns, comments=("SplatRenderMode: mip",))
    out = tmp_path / "labelled.ply"
    arguments = ["attach", str(desk / "run"), str(tmp_path / "cloud.ply"), "--scene", str(room)]
    assert main([*arguments, "--out", str(out)]) == 0
    columns = read_ply(out)
    np.testing.assert_array_equal(columns["mass"], np.arange(len(surface)))
    assert (columns["class_id"] >= 0).mean() > 0.8
    assert set(columns["red"].tolist()) == {200}
    assert "SplatRenderMode: mip" in read_header(out).comments
    names = json.loads((tmp_path / "labelled.ply.classes.json").read_text())
    assert names["class_id"]["1"] == "floor"
    assert names["distance"] > 0


def test_a_scene_without_points_is_told_that_some_are_found(room, tmp_path, capsys):
    (tmp_path / "images").symlink_to(room / "images")
    poses = np.eye(4)[None].repeat(2, 0)
    poses[1, 0, 3] = 1
    names = [f"images/{picture.name}" for picture in sorted((room / "images").iterdir())[:2]]
    frames = [{"file_path": n, "transform_matrix": E.tolist()} for n, E in zip(names, poses, strict=True)]
    camera = {"fl_x": 60.0, "fl_y": 60.0, "cx": 40.0, "cy": 30.0, "w": 80, "h": 60, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(camera))
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "run")]) == 1
    said = capsys.readouterr()
    assert "triangulate some from the poses before they train" in said.out
    assert f"{tmp_path / 'features'}: expected a folder of feature maps" in said.err


def test_any_option_of_a_method_is_set_by_its_name(room, tmp_path, capsys):
    changed = Settings(3_000, ("codebook.maximum=50", "training.densify.maximum=none", "autoencoder.latent=12"))
    method = changed.of(kfgs.Paper.paper(), "--method paper-full")
    assert (method.codebook.maximum, method.autoencoder.latent, method.training.densify.maximum) == (50, 12, None)
    assert (method.training.steps, method.training.densify.stop) == (3_000, 1_500)
    command = ["fit", str(room), "--out", str(tmp_path), "--method", "paper", "--set"]
    for word, shown in (
        ("alpha=1", "got 'alpha=1'; its groups: codebook, autoencoder, training; did you mean codebook.expand_below?"),
        ("training.densify.gradient=x", "expected training.densify.gradient as float, got"),
        ("training.densify.maximum=0", "got 0; none is allowed, too"),
    ):
        assert main([*command, word]) == 1
        assert shown in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["fit", "--method", "grown", "--set", "help"])
    assert "\ntraining.densify.gradient=0.0008  A Gaussian" in capsys.readouterr().out
    adc = Settings(set=("--autoencoder=NONE", "training.rates.means-final=1")).of(kfgs.Paper.paper(), "")
    assert (adc.autoencoder, adc.training.rates.means_final) == (None, 1.0)
    assert Settings(set=("codebook=none",)).of(adc, "").codebook is None


def test_the_papers_split_by_its_name(room):
    scene = Views(split="df3dgs").load(room)
    assert (scene.views("df3dgs"), scene.splits["test"]) == ([5], [0])


def test_sfm_says_that_the_images_of_the_scene_are_a_link(tmp_path, monkeypatch, capsys):
    def placed(images, out, **_):
        (out / "sparse" / "0").mkdir(parents=True)
        return "2 of 2 images registered"

    monkeypatch.setattr(kfgs, "run_sfm", placed)
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    photos.mkdir()
    assert main(["sfm", str(photos), "--out", str(scene)]) == 0
    assert (scene / "images").is_symlink()
    assert f"{scene / 'images'} is a link to {photos}: keep the photos there\n" in capsys.readouterr().out


def test_a_field_is_packed_and_the_file_is_taken_where_a_field_is(desk, tmp_path, capsys):
    packed, labelled = tmp_path / "a.kfgs", tmp_path / "labelled.ply"
    assert main(["convert", str(desk / "run"), str(packed), "--precision", "fine"]) == 0
    said, field = capsys.readouterr().out, SemanticField.load(packed)
    assert f"within {field.info['rounded'][0]['errors']['gaussians.means']:.3g} world units" in said
    assert "within 0.5 degrees" in said
    assert "Morton order" in said
    assert str(packed) in said
    assert main(["convert", str(packed)]) == 0
    said = capsys.readouterr().out
    assert f"{len(field)} Gaussians" in said
    assert "rounded: fine" in said
    assert "one file of 0.0" in said
    assert main(["convert", str(packed), str(labelled)]) == 0
    assert torch.equal(read_splats(labelled).labels, field.classify().labels)
