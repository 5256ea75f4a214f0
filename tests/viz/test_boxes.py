import numpy as np
import pytest
import torch
from cases_viz import data, some_gaussians, some_plotter
from kfgs.viz.boxes import add_boxes, add_names, add_selections
from messages import tells

from kfgs.labels import OrientedBox, Selection
from kfgs.viz import palette


@pytest.fixture
def plotter():
    with some_plotter() as plotter:
        yield plotter


def test_edges_are_those_of_the_box(plotter):
    angle = torch.tensor(0.4)
    axes = torch.tensor([[angle.cos(), angle.sin(), 0], [-angle.sin(), angle.cos(), 0], [0, 0, 1]])
    boxes = [
        OrientedBox(torch.tensor([1.0, 2, 3]), axes, torch.tensor([3.0, 2, 1])),
        OrientedBox.between([0] * 3, [1] * 3),
    ]
    mesh = data(add_boxes(plotter, boxes, labels=[5, 2]))
    assert mesh["box"].tolist() == [0] * 12 + [1] * 12
    assert mesh["label"].tolist() == [5] * 12 + [2] * 12
    np.testing.assert_array_equal(mesh["rgb"], palette(mesh["label"]))
    ends = mesh.points[:24].reshape(12, 2, 3)
    local = (ends[:, 1] - ends[:, 0]) @ axes.numpy().T  # along the box's axes
    for axis, edge in enumerate((6, 4, 2)):
        along = np.abs(local[np.abs(local[:, axis]) > 1e-4])
        assert len(along) == 4
        np.testing.assert_allclose(along, np.eye(3)[axis] * edge + 0 * along, atol=1e-5)
    corners = {tuple(np.round(corner, 4)) for corner in ends.reshape(-1, 3)}
    assert corners == {tuple(np.round(corner, 4)) for corner in boxes[0].corners.numpy()}


def test_names_stand_over_their_boxes(plotter):
    boxes = [OrientedBox.between([0, 0, 0], [1, 2, 3]), OrientedBox.between([5, 0, 0], [6, 1, 1])]
    names = add_names(plotter, boxes, ["low", "high"], up=(0, 0, 2))
    points = names.GetMapper().GetInputAlgorithm().GetInput()
    placed = [points.GetPoint(i) for i in range(2)]
    np.testing.assert_allclose(placed, [(0.5, 1, 3), (5.5, 0.5, 1)])
    plotter.reset_camera()
    add_boxes(plotter, boxes)
    plotter.reset_camera()
    picture = plotter.screenshot(return_img=True).reshape(-1, 3)
    assert (picture > 200).all(axis=1).sum() > 20  # white letters on black


def test_no_name_is_left_out_where_boxes_are_close():
    def drawn(names):
        with some_plotter() as plotter:
            boxes = [OrientedBox.between([0.12 * i, 0, 0], [0.12 * i + 0.1, 0.1, 0.1 + 0.02 * i]) for i in range(3)]
            add_boxes(plotter, boxes)
            add_names(plotter, boxes, names)
            plotter.view_xz()
            plotter.camera.zoom(0.6)
            return plotter.screenshot(return_img=True).astype(int)

    everything = drawn(["chair 1", "chair 2", "chair 3"])
    for i in range(3):
        others = [" " if i == j else f"chair {j + 1}" for j in range(3)]
        assert (np.abs(drawn(others) - everything).sum(axis=2) > 100).sum() > 20, f"chair {i + 1}"


def test_selections_have_colours_and_boxes_of_their_own(plotter):
    gaussians = some_gaussians()
    low, high = Selection.of(gaussians.means[:, 0] < -0.5, "low"), Selection.of(gaussians.means[:, 0] > 0.5, "high")
    drawn = add_selections(plotter, gaussians, {"low": low, "high": high})
    labels = np.where(low.mask, 0, np.where(high.mask, 1, -1))
    np.testing.assert_array_equal(data(drawn.cloud)["label"], labels)
    edges = data(drawn.boxes)
    for number, selection in enumerate((low, high)):
        corners = torch.from_numpy(np.array(edges.points).reshape(-1, 2, 3)[edges["box"] == number].reshape(-1, 3))
        box = OrientedBox.around(gaussians.means[selection.mask])
        np.testing.assert_allclose(corners.amin(0), box.corners.amin(0), atol=1e-5)
        np.testing.assert_allclose(corners.amax(0), box.corners.amax(0), atol=1e-5)
    alone = add_selections(plotter, gaussians, {"low": low, "high": high}, rest=False)
    assert data(alone.cloud).n_points == len(low) + len(high)


def test_what_nobody_selected_keeps_the_brightness_of_its_colour(plotter):
    gaussians = some_gaussians()
    some = Selection.of(gaussians.means[:, 0] < 0, "left")
    rgb = data(add_selections(plotter, gaussians, {"left": some}).cloud)["rgb"]
    np.testing.assert_array_equal(rgb[some.mask], np.tile(palette(np.array([0])), (len(some), 1)))
    rest = rgb[~some.mask.numpy()].astype(int)
    assert (rest == rest[:, :1]).all()
    own = (gaussians.sh[:, 0] * 0.28209479177387814 + 0.5).clamp(0, 1)[~some.mask].double().numpy()
    np.testing.assert_allclose(rest[:, 0], 70 + 155 * own @ [0.2126, 0.7152, 0.0722], atol=1)
    plain = data(add_selections(plotter, gaussians.replace(sh=None), {"left": some}).cloud)["rgb"]
    assert (plain[~some.mask.numpy()] == 128).all()


def test_what_cannot_be_boxed_is_named(plotter):
    gaussians = some_gaussians()
    box = OrientedBox.between([0] * 3, [1] * 3)
    none = Selection.of(torch.zeros(60, dtype=torch.bool), "nothing")
    with pytest.raises(ValueError, match=tells("boxes:", "got none")):
        add_boxes(plotter, [])
    with pytest.raises(ValueError, match=tells("labels:", "expected 1", "got 2")):
        add_boxes(plotter, [box], labels=[1, 2])
    with pytest.raises(ValueError, match=tells("names:", "expected 1", "got 0")):
        add_names(plotter, [box], [])
    with pytest.raises(ValueError, match=tells("selections:", "got none")):
        add_selections(plotter, gaussians, {})
    with pytest.raises(ValueError, match=tells("selections['chair']:", "got none")):
        add_selections(plotter, gaussians, {"chair": none})
    with pytest.raises(TypeError, match=tells("selections['chair']:", "got Tensor", "Selection.of(mask)")):
        add_selections(plotter, gaussians, {"chair": none.mask})
    with pytest.raises(ValueError, match=tells("selections['chair'].mask:", "N = 60", "got (59,)")):
        add_selections(plotter, gaussians, {"chair": Selection.of(torch.ones(59, dtype=torch.bool), "all")})
