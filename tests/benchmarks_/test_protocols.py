"""`python benchmarks/protocols.py`: results of kfgs and of other programs under one protocol, and pictures of them."""

import json
import sys

import numpy as np
import protocols
import pytest
from cases_color import make_splat, surface
from PIL import Image

from kfgs import load_scene
from kfgs.evaluation.label_pictures import load_label_map


@pytest.fixture(scope="module")
def foreign(room, tmp_path_factory):
    """A splat on the room's surface, and the text of the class of each Gaussian as its feature, as another program has them."""
    folder, text = tmp_path_factory.mktemp("splats"), np.load(room / "text.npy")
    np.save(folder / "features.npy", text[surface(room)[1]])
    return f"{make_splat(room, folder / 'splat.ply')}={folder / 'features.npy'}"


@pytest.fixture
def said(monkeypatch, capsys):
    """What the command prints."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["benchmarks/protocols.py", *map(str, words)])
        protocols.main()
        return capsys.readouterr().out

    return run


def test_several_results_are_compared_and_drawn(room, foreign, tmp_path, said):
    teacher = room / "features"
    table = said(foreign, teacher, "--scene", room, "--out", tmp_path, "--pictures", 2).splitlines()
    assert table[-2:] == ["(kfgs-pooled/1)", f"wrote {tmp_path}"]
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert set(scores) == {foreign, str(teacher)}
    assert scores[foreign]["scores"]["mIoU"] > 0.6
    pictures = sorted(tmp_path.glob("*.png"))
    assert [path.stem for path in pictures] == ["view_001", "view_007"]
    assert np.asarray(Image.open(pictures[0])).std() > 10


def test_a_foreign_splat_under_other_protocols_and_masks_that_are_found(room, foreign, tmp_path, said):
    scene, names = load_scene(room), json.loads((room / "classes.json").read_text())
    folder = tmp_path / "segmentations"
    folder.mkdir()
    (folder / "classes.txt").write_text("\n".join(names))
    for i in scene.views("test"):
        labels = load_label_map(room / "labels" / f"{scene.stem(i)}.png").numpy()
        (folder / scene.stem(i)).mkdir()
        for label in np.unique(labels):
            Image.fromarray(np.uint8(labels == label) * 255).save(folder / scene.stem(i) / f"{names[label]}.png")
    words = [foreign, "--scene", room, "--protocol"]
    assert "agreement" in said(*words, "kfgs-surface")
    assert "mIoU" in said(*words, "feature3dgs-teacher", "--set", "split=null")
    long = said(*words, "3dovs-closed", "--truth", tmp_path, "--long")
    assert "3dovs-closed/1" in long
    assert "each pixel takes the most similar text" in long
