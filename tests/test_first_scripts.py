"""The five scripts of docs/recipes.md, which a new user writes first; they run as they stand on the toy room."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_room import make_desk

import kfgs
from kfgs import SemanticField, attach, read_splats
from kfgs.viz import available

PAGE = Path(kfgs.__file__).parents[1] / "docs" / "recipes.md"


@pytest.fixture(scope="module")
def scripts():
    if not PAGE.is_file():
        pytest.skip("kfgs is installed without its repository: no docs/recipes.md beside it")
    found = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(found) == 5
    return found


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_desk(tmp_path_factory.mktemp("room"))


@pytest.fixture(autouse=True)
def inside(room, monkeypatch):
    monkeypatch.chdir(room)


def run(script):
    known = {}
    exec(script, known)
    return known


def test_a_picture_of_the_features_from_a_new_viewpoint(scripts):
    run(scripts[0])
    picture = np.asarray(Image.open("features.png"))
    assert picture.shape == (60, 80, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_the_gaussians_of_a_class_in_pyvista(scripts):
    if not available():
        pytest.skip("nothing can be drawn here")
    known = run(scripts[1])
    points, chairs = known["points"], known["chairs"]
    assert points.n_points == len(chairs) > 20
    assert points["rgb"].shape == (len(chairs), 3)
    assert np.asarray(Image.open("chairs.png")).std() > 5


def test_labels_for_a_splat_of_another_program(scripts):
    run(scripts[2])
    field, again = SemanticField.load("run/field.kfgs"), read_splats("labelled.ply")
    assert again.names == field.classes.names
    true = np.load("scene/surface.npz")["labels"]
    assert (again.labels.numpy() == true).mean() > 0.6
    same = attach(field, read_splats("my.ply")).labels
    assert same.equal(again.labels)


def test_how_the_codebook_grew(scripts):
    book = run(scripts[3])["book"]
    assert book.report.history[-1]["size"] == book.size
    assert np.asarray(Image.open("growth.png")).shape[1] > 600


def test_the_chairs_as_points_and_box_for_trimesh_or_open3d(scripts):
    known = run(scripts[4])
    chairs, points, box, corners = (known[name] for name in ("chairs", "points", "box", "corners"))
    assert points.shape == (len(chairs), 3)
    assert corners.shape == (8, 3)
    inside = np.abs((points - box.center.numpy()) @ box.axes.numpy().T) <= box.half.numpy() + 1e-6
    assert inside.all()
    assert (corners.min(axis=0) <= points.min(axis=0) + 1e-6).all()
    assert np.allclose(sorted(2 * box.half), sorted(np.linalg.norm(corners[[1, 2, 4]] - corners[0], axis=1)), atol=1e-5)
