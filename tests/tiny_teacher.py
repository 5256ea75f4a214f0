"""A teacher for batches, which workers import by its name: colours, mixed into as many channels as small rooms have."""

import os
import signal
from pathlib import Path

import torch
from small_room import ROOM

MATRIX = torch.randn(ROOM.feature_dim, 3, generator=torch.Generator().manual_seed(1))


class Tiny:
    """With `deadly`, the process that sees the first picture is killed, once; the folder remembers it."""

    def __init__(self, deadly=""):
        self.name = "tiny"
        self.identity = {"name": "tiny"}
        self.deadly = deadly

    def encode_image(self, image):
        if self.deadly:
            killed = Path(self.deadly) / "killed"
            if not killed.exists():
                killed.touch()
                os.kill(os.getpid(), signal.SIGKILL)
        return torch.einsum("dc,chw->dhw", MATRIX, torch.nn.functional.avg_pool2d(image, 2) - 0.4)

    def encode_text(self, prompts):
        raise NotImplementedError
