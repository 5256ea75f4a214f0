import numpy as np
import torch
from cases_viz import data, some_plotter
from messages import refused

from kfgs.labels import OrientedBox
from kfgs.viz import add_boxes, palette


def between(low, high):
    """A box along the world's axes."""
    low, high = torch.tensor(low).double(), torch.tensor(high).double()
    return OrientedBox((low + high) / 2, torch.eye(3).double(), (high - low) / 2)


def test_edges_are_those_of_the_box(plotter):
    angle = torch.tensor(0.4)
    axes = torch.tensor([[angle.cos(), angle.sin(), 0], [-angle.sin(), angle.cos(), 0], [0, 0, 1]])
    boxes = [OrientedBox(torch.tensor([1.0, 2, 3]), axes, torch.tensor([3.0, 2, 1])), between([0] * 3, [1] * 3)]
    mesh = data(add_boxes(plotter, boxes))
    assert mesh["box"].tolist() == [0] * 12 + [1] * 12
    assert mesh["label"].tolist() == [0] * 12 + [1] * 12
    np.testing.assert_array_equal(mesh["rgb"], palette(mesh["label"]))
    ends = mesh.points[:24].reshape(12, 2, 3)
    local = (ends[:, 1] - ends[:, 0]) @ axes.numpy().T  # along the box's axes
    for axis, edge in enumerate((6, 4, 2)):
        along = np.abs(local[np.abs(local[:, axis]) > 1e-4])
        assert len(along) == 4
        np.testing.assert_allclose(along, np.eye(3)[axis] * edge + 0 * along, atol=1e-5)
    corners = {tuple(np.round(corner, 4)) for corner in ends.reshape(-1, 3)}
    assert corners == {tuple(np.round(corner, 4)) for corner in boxes[0].corners.numpy()}


def test_no_name_is_left_out_where_boxes_are_close():
    def drawn(names):
        with some_plotter() as plotter:
            boxes = [between([0.12 * i, 0, 0], [0.12 * i + 0.1, 0.1, 0.1 + 0.02 * i]) for i in range(3)]
            add_boxes(plotter, boxes, names=names)
            plotter.view_xz()
            plotter.camera.zoom(0.6)
            return plotter.screenshot(return_img=True).astype(int)

    everything = drawn(["chair 1", "chair 2", "chair 3"])
    for i in range(3):
        others = [" " if i == j else f"chair {j + 1}" for j in range(3)]
        assert (np.abs(drawn(others) - everything).sum(axis=2) > 100).sum() > 20, f"chair {i + 1}"


def test_what_cannot_be_boxed_is_named(plotter):
    box = between([0] * 3, [1] * 3)
    refused(lambda: add_boxes(plotter, []), "boxes:", "got none")
    refused(lambda: add_boxes(plotter, [box], names=["a", "b"]), "names:", "expected 1", "got 2")
