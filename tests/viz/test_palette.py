import numpy as np
import pytest
import torch
from messages import tells
from oracles_palette import OKABE_ITO, make_palette, worst_distance

from kfgs.viz import PALETTE, palette


def test_table_follows_its_recipe():
    np.testing.assert_array_equal(PALETTE, make_palette())


def test_first_colours_are_okabe_and_ito():
    assert [bytes(row).hex() for row in PALETTE[:7]] == OKABE_ITO


@pytest.mark.parametrize(("size", "least"), [(20, 17), (64, 9), (256, 3.9)])
def test_colours_differ_for_normal_and_colour_blind_eyes(size, least):
    distances = worst_distance(PALETTE[:size], PALETTE[:size])
    np.fill_diagonal(distances, np.inf)
    assert distances.min() >= least
    assert worst_distance(PALETTE[7:size], np.array([[128, 128, 128]])).min() >= 3.9  # grey means "none"


def test_labels_of_any_shape_and_kind():
    labels = torch.tensor([[0, -1, 255], [256, 7, 3]])
    rgb = palette(labels)
    assert (rgb.shape, rgb.dtype) == ((2, 3, 3), np.uint8)
    assert rgb[0, 1].tolist() == [128, 128, 128]
    assert rgb[1, 0].tolist() == rgb[0, 0].tolist() == PALETTE[0].tolist()  # 256 colours, then again
    np.testing.assert_array_equal(palette(labels.numpy().astype(np.int16)), rgb)
    assert palette(np.array([255], dtype=np.uint8)).tolist() == [PALETTE[255].tolist()]
    assert palette(np.empty((0,), dtype=np.int64)).shape == (0, 3)


def test_wrong_labels_are_named():
    with pytest.raises(TypeError, match=tells("labels:", "got float32")):
        palette(torch.zeros(3))
    with pytest.raises(ValueError, match=tells("labels:", "-1", "got -2")):
        palette(torch.tensor([0, -2]))
