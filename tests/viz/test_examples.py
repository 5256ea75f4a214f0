import dataclasses

import numpy as np
import pytest
import torch
from cases_viz import some_camera
from messages import refused

from kfgs.fields import Box, Clicks, Mask
from kfgs.viz import draw_examples, palette
from kfgs.viz.pictures import GAP, draw_legend

WIDTH = 320
NAMES = ["chair", "wall", "plant"]
COLORS = palette(np.arange(3), NAMES)
HEAD = 12 * 3 // 2 + GAP  # of a title in letters of 12 pixels
ONE = dataclasses.replace(some_camera(), name="a/one.png")  # 160 x 120: drawn twice as large
TWO = dataclasses.replace(some_camera(160, 160), name="two.png")


def grey(camera):
    return np.full((camera.height, camera.width, 3), 90, np.uint8)


def places(picture, color):
    """Rows and columns of a colour, in the first view."""
    found = np.argwhere((picture[HEAD:, GAP : GAP + WIDTH] == color).all(axis=-1))
    return found[found[:, 0] < 2 * ONE.height]


def test_points_boxes_and_masks_lie_where_they_were_shown_in_the_colours_of_their_classes():
    mask = torch.zeros(120, 160, dtype=torch.bool)
    mask[80:100, 110:150] = True
    examples = {
        "chair": Clicks("one", [(20.5, 30.5)]),
        "wall": [Box("a/one.png", (50, 10, 90, 60)), torch.tensor([1])],
        "plant": [Mask(ONE, mask)],
    }
    picture = draw_examples([ONE, TWO], examples, grey, width=WIDTH)
    strip = draw_legend(np.arange(3), NAMES, width=picture.shape[1])
    assert picture.shape == (HEAD + 240 + GAP + len(strip), WIDTH + 2 * GAP, 3)
    assert (picture[-len(strip) :] == strip).all()
    assert places(picture, COLORS[0]).mean(axis=0) == pytest.approx([61, 41], abs=0.6)
    assert places(picture, COLORS[1]).min(axis=0).tolist() == [20, 100]
    assert places(picture, COLORS[1]).max(axis=0).tolist() == [120, 180]
    assert places(picture, COLORS[2]).min(axis=0) == pytest.approx([160, 220], abs=1)
    assert places(picture, COLORS[2]).max(axis=0) == pytest.approx([199, 299], abs=1)
    assert not (picture[HEAD + 180, GAP + 260] == COLORS[2]).all()  # the outline alone
    assert (picture == 255).all(axis=-1)[HEAD + 20, GAP + 140 : GAP + 142].sum() == 0
    assert (picture[HEAD : HEAD + 240, GAP : GAP + WIDTH] == 90).all(axis=-1).mean() > 0.9


@pytest.mark.parametrize(
    ("examples", "error", "message"),
    [
        ({}, ValueError, ("examples:", "in a view", "got none", "Clicks")),
        ({"chair": torch.tensor([1])}, ValueError, ("examples:", "in a view", "got none")),
        (
            {"chair": Clicks("three.png", [(1, 1)])},
            ValueError,
            ("examples['chair'][0]:", "a/one.png", "got 'three.png'"),
        ),
        ({"chair": Mask("two", torch.ones(2, 2, dtype=torch.bool))}, ValueError, ("mask:", "got (2, 2)")),
    ],
)
def test_what_cannot_be_drawn_is_named(examples, error, message):
    refused(lambda: draw_examples([ONE, TWO], examples, grey), *message, error=error)
