"""A class has one colour in every picture: names travel with the cloud, and a walk over everything that colours classes."""

import numpy as np
import pytest
import pyvista as pv
import torch
from cases_viz import data, some_camera, some_gaussians, some_plotter
from PIL import Image

from kfgs.fields import Box
from kfgs.labels import LabelSet, OfClass, connected_parts
from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration
from kfgs.viz import (
    add_boxes,
    add_cloud,
    add_legend,
    draw_examples,
    linked_clouds,
    overlay_labels,
    palette,
    picture_grid,
    plot_iou,
    save_animation,
    show_cloud,
    show_transfer,
    to_pyvista,
)

# by number, a chair would have the floor's brown, the sofa's blue ...
NAMES = ("wall", "floor", "chair", "sofa", "lamp")
CLOUD = some_gaussians().replace(names=NAMES)
CHAIR = NAMES.index("chair")
MAP = torch.full((20, 20), CHAIR)
CHAIRS = CLOUD.select(OfClass("chair").select(CLOUD)).replace(opacities=torch.full((10,), 0.999))


@pytest.fixture
def plotter():
    with some_plotter() as plotter:
        yield plotter
    pv.close_all()


def of_points(mesh):
    return mesh["rgb"][mesh["label"] == CHAIR]


def in_cloud(style, **options):
    return lambda plotter, _: of_points(data(add_cloud(plotter, CLOUD, style=style, **options)))


def in_links(_, tmp_path):
    plotter = linked_clouds(CLOUD, CLOUD, off_screen=True)
    return of_points(
        next(data(a) for a in plotter.actors.values() if hasattr(a, "mapper") and "rgb" in data(a).point_data)
    )


def in_lines(_, tmp_path):
    plotter = show_transfer(CLOUD, CLOUD.replace(labels=None), 0.3, off_screen=True)
    lines = data(plotter.actors["transfer"])
    return lines["rgb"][lines["label"] == CHAIR]


def in_boxes(plotter, _):
    return data(add_boxes(plotter, connected_parts(CLOUD, "chair", distance=9.0)))["rgb"]


def in_legend(plotter, _):
    add_legend(plotter, CHAIRS)
    return mode(plotter.screenshot(return_img=True))


def in_film(_, tmp_path):
    path = save_animation(
        tmp_path / "a.gif", lambda camera: np.full((*camera.size, 3), 255), [some_camera()], legend=CHAIRS
    )
    with Image.open(path) as film:
        return mode(np.asarray(film.convert("RGB")))


def in_bar(_, tmp_path):
    (bar,) = plot_iou(np.array([np.nan, np.nan, 0.5, np.nan, np.nan]), NAMES).axes[0].patches
    return np.array([bar.get_facecolor()[:3]]) * 255


def in_examples(_, tmp_path):
    camera = some_camera()
    examples = {name: [Box("", (5, 5, 60, 60))] if name == "chair" else [] for name in NAMES}
    sheet = draw_examples([camera], examples, lambda camera: np.full((*camera.size, 3), 255, np.uint8))
    return sheet[: camera.height * 3].reshape(-1, 3)


def in_viewer(_, tmp_path):
    return Exploration(SplatMeaning(CLOUD)).colors("semantic")[CLOUD.labels == CHAIR]


def mode(picture):
    """The most frequent colour that is not white, black or grey."""
    colors, counts = np.unique(picture[..., :3].reshape(-1, 3), axis=0, return_counts=True)
    return colors[np.argmax(counts * (np.ptp(colors.astype(int), axis=1) > 20))][None]


WALK = {
    "palette": lambda *_: palette([CHAIR], CLOUD)[None],
    "palette of a label set": lambda *_: palette([CHAIR], LabelSet(NAMES, torch.eye(5))),
    "points": in_cloud("points"),
    "gaussians": in_cloud("gaussians"),
    "ellipsoids": in_cloud("ellipsoids"),
    "one class": in_cloud("points", color_by="chair"),
    "to_pyvista": lambda *_: of_points(to_pyvista(CLOUD)),
    "show_cloud": lambda *_: mode(show_cloud(CHAIRS.replace(scales=CHAIRS.scales * 9))(some_camera())),
    "linked_clouds": in_links,
    "show_transfer": in_lines,
    "add_boxes": in_boxes,
    "add_legend": in_legend,
    "save_animation": in_film,
    "overlay_labels": lambda *_: overlay_labels(torch.zeros(20, 20, 3), MAP, CLOUD, alpha=1.0)[5:15, 5:15].reshape(
        -1, 3
    ),
    "its legend": lambda *_: mode(overlay_labels(torch.zeros(20, 200, 3), MAP[:, :1].expand(20, 200), NAMES, alpha=0)),
    "picture_grid": lambda *_: picture_grid([[np.zeros((9, 400, 3))]], names=NAMES).reshape(-1, 3),
    "plot_iou": in_bar,
    "draw_examples": in_examples,
    "viewer": in_viewer,
}


@pytest.mark.parametrize("place", WALK)
def test_a_chair_has_the_colour_of_a_chair(place, plotter, tmp_path):
    colors, expected = np.asarray(WALK[place](plotter, tmp_path)), palette([CHAIR], NAMES)[0].astype(int)
    near = np.abs(colors.astype(int).reshape(-1, 3) - expected).max(axis=1) <= 3
    many = place in ("picture_grid", "draw_examples")  # pictures of several classes
    assert near.sum() >= 10 if many else len(near) and near.all()


def test_a_class_without_a_name_has_the_colour_of_its_number_everywhere():
    plain = CLOUD.replace(names=())
    expected = palette(plain.labels)
    np.testing.assert_array_equal(to_pyvista(plain)["rgb"], expected)
    np.testing.assert_array_equal(Exploration(SplatMeaning(plain)).colors("semantic"), expected)
    np.testing.assert_array_equal(palette([3, 0], ["class 0", "class 1", "class 2", "class 3"]), palette([3, 0]))
    half = CLOUD.replace(names=NAMES[:3])
    np.testing.assert_array_equal(to_pyvista(half)["rgb"][half.labels == CHAIR][0], palette([CHAIR], NAMES)[0])


def test_colours_by_word(plotter):
    rgb = to_pyvista(CLOUD, "chair")["rgb"]
    assert (rgb[CLOUD.labels != CHAIR] == 128).all()
    np.testing.assert_array_equal(to_pyvista(CLOUD, "class")["rgb"], to_pyvista(CLOUD, "label")["rgb"])
    scored = CLOUD.replace(scores=torch.linspace(0, 1, 60))
    np.testing.assert_array_equal(to_pyvista(scored, "score")["score"], scored.scores)
    chosen = OfClass("chair").select(CLOUD)
    np.testing.assert_array_equal(to_pyvista(CLOUD, chosen)["score"], chosen.scores)


def test_parts_have_their_box_their_class_and_a_number(plotter):
    parts = connected_parts(CLOUD, "chair", distance=0.9, smallest=1)
    assert len(parts) > 1
    assert sum(len(part.gaussians) for part in parts) == 10
    assert (parts[0].gaussians.labels == CHAIR).all()
    pictures = []
    for names in ((), [f"chair {i + 1}" for i in range(len(parts))], ["bench"] * len(parts)):
        plotter.clear()
        assert set(data(add_boxes(plotter, parts, names=names))["label"]) == {CHAIR}
        pictures.append(plotter.screenshot(return_img=True))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0] != pictures[2]).any()
