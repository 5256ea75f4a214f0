"""Points, meshes, boxes and labels that Python shows with a scene."""

import base64
from types import SimpleNamespace

import cases_explorer
import cases_page
import cases_web
import numpy as np
import pytest
import pyvista
import torch
from cases_web import needs_chromium
from messages import refused

from kfgs.cameras import Camera
from kfgs.labels import OrientedBox
from kfgs.splat.sh import rgb_to_sh0
from kfgs.viewer import Exploration, SplatMeaning, Viewer
from kfgs.viewer.pack import pack_scene

CORNERS = [[0.0, 0, 4], [1, 0, 4], [0, 1, 4]]
CAMERA = Camera(torch.eye(4), torch.tensor([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]]), 80, 60)


def array(thing, name, kind, width=3):
    return np.frombuffer(base64.b64decode(thing[name]), kind).reshape(-1, width)


@pytest.fixture
def viewer():
    return Viewer(cases_page.exploration(("table", "chair", "odd")))


def test_points_have_one_colour_or_one_each(viewer):
    things = viewer.state.things
    viewer.add("p", CORNERS)
    assert array(things["p"], "places", "<f4").tolist() == CORNERS
    assert (array(things["p"], "colors", np.uint8) == (61, 139, 255)).all()
    for color in ([[255, 0, 9]] * 3, torch.tensor([[1.0, 0, 9 / 255]] * 3), "#ff0009", (1, 0, 9 / 255)):
        viewer.add("p", torch.tensor(CORNERS), color=color)
        assert array(things["p"], "colors", np.uint8).tolist() == [[255, 0, 9]] * 3
    viewer.remove("p")
    assert things == {}
    refused(lambda: viewer.remove("p"), "name:", "got 'p'")


def test_meshes_are_those_of_pyvista_and_trimesh(viewer):
    trimesh = pytest.importorskip("trimesh")
    plain, painted, grey = pyvista.Cube(), pyvista.Cube(), trimesh.creation.box((1, 1, 1))
    plain["colors"] = np.arange(plain.n_points)  # numbers are no colours
    painted["rgb"] = np.full((painted.n_points, 3), 7, np.uint8)
    for thing, color in ((plain, (61, 139, 255)), (painted, 7), (grey, 102)):
        viewer.add("cube", thing)
        made = viewer.state.things["cube"]
        places, faces = array(made, "places", "<f4"), array(made, "faces", "<u4")
        a, b, c = places[faces].astype(float).transpose(1, 0, 2)
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(6)
        assert (array(made, "colors", np.uint8) == color).all()


def test_boxes_and_labels_are_marks_in_the_frame_of_the_scene():
    cloud = cases_page.exploration().cloud("color").replace(origin=(1000.0, 0, 0))
    viewer, far = Viewer(Exploration(SplatMeaning(cloud))), torch.tensor([1000.0, 0, 0])
    box = OrientedBox.around(torch.tensor(CORNERS) + far)
    viewer.add("boxes", [box, box])
    viewer.add("here", (1000, 1, 2))
    assert viewer.state.things["here"]["marks"] == [[[0, 1, 2]]]
    np.testing.assert_allclose(viewer.state.things["boxes"]["marks"], 2 * [(box.corners - far).tolist()])


@pytest.mark.parametrize(
    ("thing", "color", "words"),
    [
        ([[0, 1]], None, ["thing:", "[N, 3]", "(1, 2)"]),
        ([[0, 1, np.nan]], None, ["thing:", "NaN"]),
        ([[0, 1, 1e39]], None, ["thing:", "infinity"]),
        ("room.ply", None, ["thing:", "str"]),
        (CORNERS, "reddish", ["color:", "'reddish'"]),
        (CORNERS, [[0, 0, 0]], ["color:", "N = 3", "(1, 3)"]),
        (SimpleNamespace(vertices=CORNERS, faces=[[0, 1, 3]]), None, ["thing.faces:", "[0, 2]", "3"]),
    ],
)
def test_what_cannot_be_shown_is_refused(viewer, thing, color, words):
    refused(lambda: viewer.add("x", thing, color=color), *words, error=(ValueError, TypeError))
    assert viewer.state.things == {}


@needs_chromium[0]
@needs_chromium[1]
@pytest.mark.parametrize("deep", [3.0, 5.0])
def test_a_mesh_is_hidden_by_gaussians_in_front_and_hides_those_behind(browser, deep):
    """A faint green wall of Gaussians at depth 4, a dense blue one at 6, and a red square in front of or behind the first."""
    y, x = torch.meshgrid(torch.linspace(-3, 3, 61), torch.linspace(-3, 3, 61), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 4.0)], dim=-1).reshape(-1, 3)
    means, n = torch.cat([wall, wall + torch.tensor([0.0, 0, 2])]), len(wall)
    rgb = torch.tensor([[0.0, 1, 0], [0, 0, 1]]).repeat_interleave(n, dim=0)
    cloud = cases_explorer.cloud(means, sh=rgb_to_sh0(rgb)[:, None])
    opacities = torch.tensor([0.1, 0.9]).repeat_interleave(n)
    cloud = cloud.replace(scales=torch.tensor([[0.1, 0.1, 0.001]]).repeat(2 * n, 1), opacities=opacities)
    state = Exploration(SplatMeaning(cloud), cameras=[CAMERA])
    shown = cases_web.Viewer(browser, pack_scene(state))
    before = shown.picture(CAMERA, "semantic")
    square = pyvista.Plane(center=(0, 0, deep), direction=(0, 0, 1), i_size=deep / 5, j_size=deep / 5)
    Viewer(state).add("square", square, color="red")
    shown.run("(things) => renderer.setSolids(things)", list(state.things.values()))
    after = shown.picture(CAMERA, "semantic")
    inside = np.s_[21:39, 31:49]
    np.testing.assert_allclose(after[:18], before[:18], atol=1 / 255)  # around the square
    green = 0 if deep < 4 else before[inside][..., 1]
    np.testing.assert_allclose(after[inside][..., 1], green, atol=2 / 255)
    assert after[inside][..., 2].max() <= 1 / 255  # the blue wall is behind it
    red = 1 - np.asarray(green)  # what the green wall lets through
    np.testing.assert_allclose(after[inside][..., 0], red, atol=0.01)
    shown.run("() => renderer.setSolids([])")
    np.testing.assert_array_equal(shown.picture(CAMERA, "semantic"), before)
    assert shown.errors == []
