from dataclasses import replace

import oracles_lseg
import pytest
import torch
from lseg_layout import TINY as TINY_LSEG
from lseg_layout import random_state

from kfgs.teachers.lseg.keys import text_from_state

TINY = replace(TINY_LSEG, text_layers=3)
IDS = torch.tensor(
    [[58, 3, 59, 0, 0, 0, 0, 0, 0], [58, 7, 41, 5, 20, 33, 2, 59, 0], [58, 59, 59, 59, 59, 59, 59, 59, 59]]
)


@pytest.fixture(scope="module")
def state():
    return random_state(TINY, torch.Generator().manual_seed(6))


def relative(ours, theirs):
    return float((ours - theirs).abs().max() / theirs.abs().max())


def test_embeddings_are_those_of_transformers_clip(state):
    expected = oracles_lseg.text(state, TINY, IDS)
    tower = text_from_state(state, TINY, source="tiny")
    assert relative(tower.double()(input_ids=IDS).text_embeds, expected) < 1e-12


def test_what_follows_the_end_does_not_matter(state):
    tower = text_from_state(state, TINY, source="tiny").double()
    padded = IDS.clone()
    padded[0, 3:] = torch.tensor([59, 1, 2, 3, 4, 5])
    torch.testing.assert_close(tower(padded).text_embeds[0], tower(IDS).text_embeds[0], rtol=1e-12, atol=1e-12)
    padded[0, 1] = 4
    assert (tower(padded).text_embeds[0] - tower(IDS).text_embeds[0]).abs().max() > 1e-3
