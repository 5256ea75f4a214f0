"""LSeg made tiny, as a teacher of a user's own."""

from pathlib import Path

import torch
from lseg_layout import random_state

from kfgs.teachers.lseg import LSegConfig, load_lseg

TINY = LSegConfig(
    width=32, depth=4, heads=4, window=64, position_grid=3, hooks=(0, 1, 2, 3), neck=(8, 12, 16, 20), fusion=12, dim=16,
    text_width=32, text_layers=2, text_heads=4,
)  # fmt: skip


class TinyLSeg:
    """LSeg's own code with a tiny network, one window per picture; `package.module:TinyLSeg` on the command line."""

    name = "lseg"

    def __init__(self, weights):
        self.lseg = load_lseg(weights, config=TINY, fast=True)

    @property
    def identity(self):
        return self.lseg.identity

    def encode_image(self, image):
        return self.lseg.encode_image(image)

    def encode_text(self, prompts):
        return self.lseg.encode_text(prompts)


def save_checkpoint(path: Path, seed: int = 0) -> Path:
    """A checkpoint as LSeg's authors wrote theirs, of the tiny network and random weights."""
    state = random_state(TINY, torch.Generator().manual_seed(seed))
    torch.save({"epoch": 200, "state_dict": state, "hyper_parameters": {"backbone": "clip_vitl16_384"}}, path)
    return path
