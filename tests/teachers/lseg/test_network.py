import dataclasses

import oracles_lseg
import pytest
import torch
from lseg_layout import random_state
from torch import nn
from torch.nn import functional

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


@pytest.fixture(scope="module")
def case():
    """A checkpoint, two windows, and their features by transformers in float64."""
    generator = torch.Generator().manual_seed(5)
    state = random_state(TINY, generator)
    x = 2 * torch.rand(2, 3, 64, 64, generator=generator, dtype=torch.float64) - 1
    return state, x, oracles_lseg.features(state, TINY, x)


def relative(ours, theirs):
    return float(((ours - theirs).abs().max() / theirs.abs().max()).detach())


def test_features_are_those_of_transformers_dpt(case):
    state, x, expected = case
    network = network_from_state(state, TINY, source="tiny")
    assert expected.shape == (2, 24, 32, 32)
    assert expected.std() > 0.1
    assert relative(network.double()(x), expected) < 1e-12


@pytest.mark.parametrize("position_grid", [3, 4, 7])
def test_features_in_float32(position_grid):
    generator = torch.Generator().manual_seed(11)
    config = LSegConfig(**{**SIZES, "position_grid": position_grid})
    state = random_state(config, generator)
    x = 2 * torch.rand(1, 3, 64, 64, generator=generator) - 1
    network = network_from_state(state, config, source="tiny")
    assert relative(network(x), oracles_lseg.features(state, config, x, "eager")) < 1e-5


def set_epsilon(network, kind, value):
    for module in network.modules():
        if isinstance(module, kind):
            module.eps = value


def patch_interpolate(network, monkeypatch):
    original = functional.interpolate
    monkeypatch.setattr(
        functional, "interpolate", lambda x, **options: original(x, **{**options, "align_corners": False})
    )


def swap_readout(network, monkeypatch):
    weight = network.reassemble[1].project.weight.data
    network.reassemble[1].project.weight.data = weight.roll(weight.shape[1] // 2, 1)


def swap_query_and_value(network, monkeypatch):
    qkv = network.vit.encoder.blocks[2][0].fn[1].qkv
    qkv.weight.data = qkv.weight.data.unflatten(0, (3, -1)).flip(0).flatten(0, 1)


MISTAKES = {
    "tanh GELU": lambda n, m: n.vit.encoder.blocks[0][1].fn[1].__setitem__(1, nn.GELU("tanh")),
    "hook off by one": lambda n, m: setattr(n, "config", dataclasses.replace(TINY, hooks=(0, 1, 2, 4))),
    "LN eps 1e-5": lambda n, m: set_epsilon(n, nn.LayerNorm, 1e-5),
    "BN eps 1e-3": lambda n, m: set_epsilon(n, nn.BatchNorm2d, 1e-3),
    "BN of the batch": lambda n, m: n.fusion[0].train(),
    "align_corners": patch_interpolate,
    "bias where none": lambda n, m: setattr(
        n.reassemble[0].narrow, "bias", nn.Parameter(torch.full((16,), 1e-3).double())
    ),
    "readout before patches": swap_readout,
    "value before key before query": swap_query_and_value,
    "scale of attention": lambda n, m: setattr(n.vit.encoder.blocks[1][0].fn[1], "num_heads", 2),
    "levels swapped": lambda n, m: n.fusion.insert(0, n.fusion.pop(1)),
    "last norm": lambda n, m: n.vit.encoder.blocks[4].append(nn.LayerNorm(32, dtype=torch.float64)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_planted_mistake_is_noticed(case, mistake, monkeypatch):
    state, x, expected = case
    network = network_from_state(state, TINY, source="tiny").double()
    MISTAKES[mistake](network, monkeypatch)
    assert relative(network(x), expected) > 1e-5  # which is more than float32 is granted


def test_the_defaults_are_those_of_the_released_checkpoint():
    config = LSegConfig()
    assert config.grid == 30


def test_with_all_channels_it_is_still_transformers_dpt_and_clip():
    """3 GiB. The released window is the next test's; benchmarks/lseg_exact.py measures both in one."""
    config, generator = LSegConfig(window=96), torch.Generator().manual_seed(12)
    state = random_state(config, generator)
    x = 2 * torch.rand(1, 3, 96, 96, generator=generator) - 1
    ids = torch.zeros(2, 77, dtype=torch.int64)
    ids[0, :3], ids[1, :5] = torch.tensor([49406, 320, 49407]), torch.tensor([49406, 17, 40000, 9, 49407])
    network, tower = (build(state, config, source="full") for build in (network_from_state, text_from_state))
    assert relative(network(x), oracles_lseg.features(state, config, x, "eager")) < 1e-5
    assert (
        relative(tower(input_ids=ids).text_embeds, oracles_lseg.text(state, config, ids, torch.float32, "eager")) < 1e-5
    )
