"""Autoencoders with given weights, and maps that count what is read, for tests."""

from __future__ import annotations

import torch

from kfgs.quant import Autoencoder


class Lazy:
    """Notes what is read, and has nothing of a sequence but length and item."""

    def __init__(self, maps):
        self.maps, self.reads = maps, []

    def __len__(self):
        return len(self.maps)

    def __getitem__(self, i):
        self.reads.append(i)
        return self.maps[i]


def made_autoencoder(encoder, decoder, low=0.0, high=1.0) -> Autoencoder:
    """The autoencoder of some layers, pairs of a weight [out, in] and a bias [out], with a range of its latents."""
    state = {"range": torch.tensor([low, high], dtype=torch.float64)}
    for name, layers in (("encoder", encoder), ("decoder", decoder)):
        for i, (weight, bias) in enumerate(layers):
            state |= {f"{name}.{i}.weight": weight, f"{name}.{i}.bias": bias}
    return Autoencoder.from_state_dict(state)


def first_channels(latents: int, dim: int, high: float = 1.0) -> Autoencoder:
    """Written down, not fitted: latents are the first channels, held to 0 ... high, and decode to them."""
    out = (torch.eye(dim, latents), torch.zeros(dim)), (torch.eye(dim), torch.zeros(dim))
    return made_autoencoder(((torch.eye(latents, dim), torch.zeros(latents)),), out, 0.0, high)
