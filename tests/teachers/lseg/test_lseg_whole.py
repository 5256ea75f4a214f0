"""LSeg from a checkpoint to features and unit rows, against a whole that shares no code with it: transformers and loops."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lseg_layout import TINY, random_state
from oracles_bpe import hugging_face, read_merges
from oracles_lseg import network, prompt_embeddings
from oracles_windows import evaluate, resize

import kfgs
from kfgs.teachers.lseg import load_lseg

DEEP = replace(TINY, depth=5, hooks=(0, 1, 3, 4), text_layers=3)
MERGES = Path(kfgs.__file__).parent / "teachers" / "data" / "clip_bpe_merges.txt.bz2"
CLOSE = 1e-5  # of the largest value: the acceptance is 1e-4

# Labels of ADE20K as LSeg is asked for them, and what people type beside them.
LABELS = [
    "wall", "building", "bed ", "windowpane", "armchair", "chest of drawers", "crt screen", "other", "Door-Stuff",
    "wall-concrete", "the red chair by the window", "a photo of a café table, 50's style", "",
]  # fmt: skip


@pytest.fixture(scope="module")
def state():
    return random_state(DEEP, torch.Generator().manual_seed(21))


@pytest.fixture(scope="module")
def checkpoint(state, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("lseg") / "demo_e200.ckpt"
    torch.save({"epoch": 200, "state_dict": state, "hyper_parameters": {"backbone": "clip_vitl16_384"}}, path)
    return path


def picture(height: int, width: int) -> np.ndarray:  # [3, H, W] float32 in [0, 1]
    """A photograph's kind of picture: smooth shades, edges, and some noise; not symmetric in any way."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    shades = np.stack([y + 0.3 * x, 0.5 + 0.5 * np.sin(9 * x + 3 * y), (x - 0.2) ** 2])
    shades += 0.4 * np.stack([x > 0.4, x + y > 0.6, y > 0.3])
    shades += 0.1 * np.random.default_rng(height + width).standard_normal(shades.shape)
    return np.clip(shades, 0, 1).astype(np.float32)


def whole(state, image, scales, flip):
    """[3, H, W] in [0, 1] -> [D, h, w] float64: brought to a long side of at most 64, transformers' DPT, one loop per step."""
    run = network(state, DEEP, torch.float64)
    _, H, W = image.shape
    x = image.astype(np.float64) * 2 - 1
    if max(H, W) > 64:
        x = resize(x, math.floor(H * 64 / max(H, W) + 0.5), math.floor(W * 64 / max(H, W) + 0.5))
    return evaluate(x, lambda window: run(torch.from_numpy(window)[None])[0].numpy(), 64, scales, flip)


def assert_close(found, expected):
    assert found.shape == expected.shape
    assert found.dtype == torch.float32
    difference = np.abs(found.double().numpy() - expected).max() / np.abs(expected).max()
    assert difference < CLOSE


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize(
    ("size", "map_size"), [((150, 113), (64, 48)), ((9, 120), (5, 64)), ((41, 29), (41, 29)), ((1, 1), (1, 1))]
)
def test_features_at_four_scales_with_flips_and_fast_are_those_of_transformers(state, checkpoint, size, map_size, fast):
    image = picture(*size)
    found = load_lseg(checkpoint, config=DEEP, fast=fast).encode_image(torch.from_numpy(image))
    assert tuple(found.shape) == (16, *map_size)
    assert_close(found, whole(state, image, (480 / 520,) if fast else (0.75, 1.0, 1.25, 1.75), flip=not fast))


def test_text_is_that_of_transformers_from_the_letters_on(state, checkpoint):
    rows = load_lseg(checkpoint, config=DEEP).encode_text(LABELS)
    expected = prompt_embeddings(state, DEEP, LABELS, hugging_face(read_merges(MERGES)))
    assert rows.shape == (len(LABELS), 16)
    assert float((rows.double() - expected).abs().max()) < CLOSE
    assert float((expected @ expected.T - torch.eye(len(LABELS))).max()) < 0.9999  # no two labels are one
