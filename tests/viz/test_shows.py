import numpy as np
import pytest
import torch
from kfgs.viz.shows import ALPHA, OUTLINE, show_classes, show_selection
from messages import tells

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.viz import palette

NAMES = ["wall", "chair", "rug"]
CAMERA = Camera(torch.eye(4), torch.tensor([[20.0, 0, 20], [0, 20, 10], [0, 0, 1]]), 40, 20)


def two(labels=(1, 2)):
    """Two opaque balls, left and right."""
    means = torch.tensor([[-1.0, 0, 2], [1, 0, 2]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.3)
    return Gaussians(means, quats, scales, torch.full((2,), 0.99), labels=torch.tensor(labels))


def gray(camera):
    return np.full((camera.height, camera.width, 3), 100, np.uint8)


def test_pixels_have_the_colours_of_their_classes():
    picture = show_classes(two(), NAMES)(CAMERA)
    assert picture.dtype == np.uint8
    assert picture[10, 10].tolist() == palette(np.array(1), NAMES).tolist()
    assert picture[10, 30].tolist() == palette(np.array(2), NAMES).tolist()
    assert (picture[0] == 255).all()
    over = show_classes(two(), NAMES, gray)(CAMERA)
    expected = ALPHA * palette(np.array(1), NAMES) + (1 - ALPHA) * 100
    assert np.abs(over[10, 10] - expected).max() <= 1
    assert (over[0] == 100).all()


def test_what_has_no_class_shows_the_picture():
    over = show_classes(two(labels=(-1, 2)), NAMES, gray)(CAMERA)
    assert over[10, 10].tolist() == [100] * 3
    assert over[10, 30].tolist() != [100] * 3
    with pytest.raises(ValueError, match=tells("gaussians:", "labels", "None")):
        show_classes(two().replace(labels=None), NAMES)


def test_a_selection_keeps_its_colours_and_the_rest_fades():
    picture = show_selection(two(), torch.tensor([True, False]), gray)(CAMERA)
    assert picture[10, 10].tolist() == [100] * 3
    assert (picture[10, 30] > 180).all()
    assert (picture == OUTLINE).all(-1).sum() > 8
    alone = show_selection(two(), torch.tensor([True, False]))(CAMERA)
    assert alone[10, 10].max() < 100
    assert (alone[10, 30] == 255).all()
    with pytest.raises(ValueError, match=tells("mask", "(3,)")):
        show_selection(two(), torch.ones(3, dtype=torch.bool))
