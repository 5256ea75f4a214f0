import math

import oracles_lseg
import pytest
import torch
from lseg_layout import layout, random_state

from kfgs.teachers.lseg.keys import network_from_state, text_from_state
from kfgs.teachers.lseg.network import LSegConfig

SIZES = {
    "width": 32,
    "depth": 5,
    "heads": 4,
    "position_grid": 4,  # the window's own: resizing rounds to float32, and is left to the test in float32
    "window": 64,
    "hooks": (0, 1, 3, 4),
    "neck": (8, 12, 16, 20),
    "fusion": 16,
    "dim": 24,
    "text_width": 16,
    "text_layers": 2,
    "text_heads": 2,
    "context": 9,
    "vocabulary": 60,
}
TINY = LSegConfig(**SIZES)


def relative(ours, theirs):
    return float(((ours - theirs).abs().max() / theirs.abs().max()).detach())


def test_layout_of_these_tests_has_the_released_tensors_and_parameters():
    shapes = layout(LSegConfig())
    assert len(shapes) == 730
    assert round(sum(math.prod(shape) for shape in shapes.values()) / 1e6, 1) == 495.1
    visual = [math.prod(shape) for name, shape in shapes.items() if ".visual." in name]
    assert round(sum(visual) / 1e6, 1) == 87.8
    assert LSegConfig().hooks == (5, 11, 17, 23)


@pytest.mark.parametrize("position_grid", [3, 4, 7])
def test_features_are_those_of_transformers_dpt(position_grid):
    generator = torch.Generator().manual_seed(11)
    config = LSegConfig(**{**SIZES, "position_grid": position_grid})
    state = random_state(config, generator)
    x = 2 * torch.rand(2, 3, 64, 64, generator=generator) - 1
    network = network_from_state(state, config, source="tiny")
    assert relative(network(x), oracles_lseg.features(state, config, x, "eager")) < 1e-5
    if position_grid == 4:
        expected = oracles_lseg.features(state, config, x.double())
        assert expected.std() > 0.1
        assert relative(network.double()(x.double()), expected) < 1e-12


def test_with_all_channels_it_is_still_transformers_dpt_and_clip():
    """With fewer blocks, which are alike; benchmarks/lseg_exact.py measures the released network."""
    config = LSegConfig(window=96, depth=4, hooks=(0, 1, 2, 3), text_layers=2)
    generator = torch.Generator().manual_seed(12)
    state = random_state(config, generator)
    x = 2 * torch.rand(1, 3, 96, 96, generator=generator) - 1
    ids = torch.zeros(2, 77, dtype=torch.int64)
    ids[0, :3], ids[1, :5] = torch.tensor([49406, 320, 49407]), torch.tensor([49406, 17, 40000, 9, 49407])
    network, tower = (build(state, config, source="full") for build in (network_from_state, text_from_state))
    assert relative(network(x), oracles_lseg.features(state, config, x, "eager")) < 1e-5
    expected = oracles_lseg.text(state, config, ids, torch.float32, "eager")
    assert relative(tower(input_ids=ids).text_embeds, expected) < 1e-5
