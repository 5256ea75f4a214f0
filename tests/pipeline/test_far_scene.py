"""A toy room moved to UTM: fit, colours, labels and edits are those of the room where it was, in the world's coordinates."""

import dataclasses
import json
import shutil

import numpy as np
import pycolmap
import pytest
import torch
from cases_training import changed
from small_room import FIELD

from kfgs import FeatureFolder, SemanticField, Uplift, attach, fit, load_scene, read_splats
from kfgs.cli import main
from kfgs.fields import UpliftConfig
from kfgs.fields.uplift import join_fields
from kfgs.formats import write_splats
from kfgs.formats.ply import read_ply, write_ply
from kfgs.pipeline.color import ColorConfig, fit_color

UTM = np.array([448262.0, 5411932.0, 200.0])
COLOR = ColorConfig(sh_degree=1, training=changed(FIELD, steps=4, start=5, stop=6))


@pytest.fixture(scope="module")
def rooms(desk, tmp_path_factory):
    """near/ and far/: a scene, my.ply, and a field of both; only the model and the splat of the second are moved."""
    root = tmp_path_factory.mktemp("rooms")
    near, far = (shutil.copytree(desk, root / name, ignore=shutil.ignore_patterns("true")) for name in ("near", "far"))
    model = far / "scene" / "sparse" / "0"
    whole = pycolmap.Reconstruction(str(model))
    whole.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
    whole.write(str(model))
    table = read_ply(far / "my.ply")
    write_ply(far / "my.ply", table | {axis: table[axis].astype(np.float64) + UTM[i] for i, axis in enumerate("xyz")})
    scene = load_scene(far / "scene")
    maps = FeatureFolder(far / "scene" / "features").of(scene, "train")
    fit(scene, maps, Uplift(far / "my.ply", UpliftConfig.field(max_gaussians=2_000)), folder=far / "run")
    return {f.name: (f, SemanticField.load(f / "run"), load_scene(f / "scene")) for f in (near, far)}


def test_labels_are_the_same(rooms):
    (_, near, scene), (folder, far, moved) = rooms["near"], rooms["far"]
    assert any("448262" in note for note in moved.notes)
    assert moved.origin != near.gaussians.origin == (0, 0, 0)
    assert np.abs(np.array(far.gaussians.origin) - UTM).max() < 5
    classes = near.classes
    same = [
        (near.segment(a, classes) == far.segment(b, classes)).double().mean()
        for a, b in zip(scene.cameras, moved.cameras, strict=True)
    ]
    assert min(same) > 0.995  # a pixel between two classes may fall the other way
    packed = far.save(folder / "field.kfgs", precision="small") or folder / "field.kfgs"
    assert SemanticField.load(packed).gaussians.origin == far.gaussians.origin
    again = join_fields([far, dataclasses.replace(far, gaussians=far.gaussians.with_origin(UTM - 20))])
    first, second = again.gaussians.means.chunk(2)
    torch.testing.assert_close(first, second, rtol=0, atol=1e-4)


def test_answers_and_files_are_in_the_world(rooms, capsys):
    answers = {}
    for name, (folder, field, _) in rooms.items():
        attached = attach(field, folder / "my.ply")
        write_splats(attached.gaussians, folder / "labelled.ply")
        assert main(["select", "chair", str(folder / "labelled.ply"), "--out", str(folder / "chosen")]) == 0
        facts = json.loads((folder / "chosen" / "selection.json").read_text())
        low, high = ([str(round(x, 3)) for x in corner] for corner in facts["parts"][0]["extent"])
        edit = ["edit", str(folder / "labelled.ply"), "--remove", "chair", "--move", "sofa:0.5,0,0"]
        assert main([*edit, "--out", str(folder / "edited.ply")]) == 0
        capsys.readouterr()
        assert main(["convert", str(folder / "edited.ply")]) == 0
        answers[name] = attached.labels, facts["parts"], (low, high), capsys.readouterr().out
    assert torch.equal(answers["near"][0], answers["far"][0])
    for near, far in zip(answers["near"][1], answers["far"][1], strict=True):
        np.testing.assert_allclose(np.array(far["centroid"]) - UTM, near["centroid"], rtol=0, atol=1e-3)
        np.testing.assert_allclose(np.array(far["extent"]) - UTM, near["extent"], rtol=0, atol=1e-3)
        assert near["indices"] == far["indices"]
    assert "448259" in answers["far"][3]
    near, far = (read_ply(rooms[name][0] / "edited.ply") for name in ("near", "far"))
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(far[axis] - UTM[i], near[axis], rtol=0, atol=1e-3)


def test_colours_are_trained_where_the_scene_is(rooms):
    clouds = {}
    for name, (folder, _, scene) in rooms.items():
        fit_color(scene, folder / "colors", COLOR)
        clouds[name] = fit_color(load_scene(folder / "scene"), folder / "colors", COLOR)  # from its stage
        saved = read_splats(folder / "colors" / "color.ply")
        np.testing.assert_allclose(
            saved.means.double() + torch.tensor(saved.origin), clouds[name].means.double() + torch.tensor(clouds[name].origin),
            rtol=0, atol=1e-4,
        )  # fmt: skip
    far = clouds["far"].means.double().numpy() + np.array(clouds["far"].origin) - UTM
    np.testing.assert_allclose(far, clouds["near"].means.numpy(), rtol=0, atol=1e-3)
