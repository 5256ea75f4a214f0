import numpy as np
from cases_viz import some_gaussians
from messages import refused

from kfgs.viz import add_legend, palette
from kfgs.viz.pictures import draw_legend

NAMES = [f"class {i}" for i in range(18)]


def colors_in(picture, labels):
    return [bool((picture.reshape(-1, 3) == palette(np.array(label), NAMES)).all(axis=1).any()) for label in labels]


def test_legend_can_be_removed_and_needs_labels(plotter):
    actor = add_legend(plotter, some_gaussians())
    assert plotter.screenshot(return_img=True).any()
    plotter.remove_actor(actor)
    plotter.render()
    assert not plotter.screenshot(return_img=True).any()
    refused(lambda: add_legend(plotter, some_gaussians()[:0]), "gaussians:", "got none")
    refused(lambda: add_legend(plotter, some_gaussians().replace(labels=None)), "gaussians:", "expected labels")


def test_column_of_bounded_height_continues_in_the_next_column():
    plain, wrapped = draw_legend(np.arange(5), NAMES, size=10), draw_legend(np.arange(5), NAMES, size=10, height=60)
    assert wrapped.shape[0] <= 60 < plain.shape[0]
    assert 2 * plain.shape[1] - 10 <= wrapped.shape[1] <= 2 * plain.shape[1]
    assert all(colors_in(wrapped, range(5)))
    np.testing.assert_array_equal(draw_legend(np.arange(5), NAMES, size=10, height=len(plain)), plain)
