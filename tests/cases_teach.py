"""LSeg made tiny, as a teacher of a user's own."""

from pathlib import Path

import torch
from lseg_layout import TINY, random_state

from kfgs.teachers.lseg import load_lseg


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
