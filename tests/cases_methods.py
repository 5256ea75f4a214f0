"""A method made of random numbers, for tests of protocols: cosines are given, so a loop can compute every score."""

import numpy as np
import torch

from kfgs import Camera, Gaussians
from kfgs.evaluation import View


class Numbers:
    """Cosines of texts by name: for pixels `maps[stem][text]` [levels, H, W], for Gaussians `own[text]` [levels, N].

    `encode` gives text i the i-th unit vector, and the method reads the index back.
    """

    name = "numbers"

    def __init__(self, texts, maps=None, own=None, gaussians=None):
        self.texts, self.maps, self.own, self.gaussians = list(texts), maps or {}, own or {}, gaussians
        known = [*self.own.values(), *(m for one in self.maps.values() for m in one.values())]
        self.levels = len(known[0])

    def encode(self, texts):
        return 3.0 * torch.eye(len(self.texts))[[self.texts.index(text) for text in texts]]

    def _asked(self, text):
        return [self.texts[int(row.argmax())] for row in text]

    def cosines(self, view, text):
        found = [torch.as_tensor(self.maps[view.stem][name]) for name in self._asked(text)]
        found = torch.stack(found, dim=-1)
        assert found.shape[1:3] == view.camera.size
        return found

    def gaussian_cosines(self, text):
        return torch.stack([torch.as_tensor(self.own[name]) for name in self._asked(text)], dim=-1)


def camera(height, width):
    return Camera(torch.eye(4), torch.tensor([[50.0, 0, width / 2], [0, 50, height / 2], [0, 0, 1]]), width, height)


def view(stem, height, width):
    return View(stem, camera(height, width))


def smooth(rng, *shape):
    """Random cosines without ties, with some large spots."""
    values = rng.normal(size=shape)
    for axis in (-2, -1):
        values = values + np.roll(values, 1, axis) + np.roll(values, 2, axis)
    return 0.25 + 0.08 * values / values.std()


def random_maps(rng, stems, texts, levels, height, width):
    return {stem: {text: smooth(rng, levels, height, width) for text in texts} for stem in stems}


def spread_gaussians(rng, count, *, scale=0.15):
    """Gaussians before the camera of `camera`."""
    means = torch.from_numpy(np.c_[rng.uniform(-1, 1, (count, 2)), rng.uniform(3, 5, count)]).float()
    scales = torch.from_numpy(rng.uniform(0.3, 1, (count, 3)) * scale).float()
    quats = torch.from_numpy(rng.normal(size=(count, 4))).float()
    return Gaussians(means, quats, scales, torch.from_numpy(rng.uniform(0.05, 0.99, count)).float())
