"""The scene's autoencoder of Sec. 3.3.2 as it is used: two small networks without a training mode."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from .._card import short_repr
from .._check import as_tensor
from .._rows import unit_rows
from .store import Stored

CHUNK = 8192  # rows at a time: the decoder's widest layer then takes 32 MB


@dataclass(frozen=True, eq=False)
class AutoencoderReport:
    """How an autoencoder was fitted, and how well it keeps the codebook apart."""

    history: list[dict[str, Any]] = field(repr=False)
    """Every `record_every` steps: step (from 1), loss (Eq. 10, mean over codewords and blends)."""
    recovered: float
    """Share of codewords whose decoded latent is quantised to that codeword again; below 1, some classes are lost
    whatever the field does: fit longer, or with more latent channels."""
    loss: float
    """Eq. 10 of the finished autoencoder, mean over codewords."""
    min_latent_distance: float
    """Smallest Euclidean distance between two codewords' latents (infinite for one codeword)."""

    __repr__ = short_repr


class Autoencoder(nn.Module, Stored):
    """Encoder E and decoder Psi of Eq. 10: D channels to d latents and back.

    Both are linear layers with ReLU between. The encoder was trained with batch normalisation; when fitting ended, its
    statistics over the whole codebook were folded into the linear layers, and the range of the latents was frozen. So
    each row is treated alone: the latent of a codeword does not depend on what else is in the batch.

    **Convention**: a latent has unit length and is then mapped from `range` to [0, 1], the same for all channels.
    (A single channel keeps its length: a unit scalar would only say -1 or 1, and have no gradient to learn from.)

    Args:
        encoder: channels D, hidden widths, d.
        decoder: channels d, hidden widths, D.
    """

    kind = "autoencoder"
    encoder: Any  # torch.nn.ModuleList of torch.nn.Linear
    decoder: Any
    range: Tensor  # [2] float64, lowest and highest number in the codewords' unit latents
    report: AutoencoderReport | None = None  # set by `fit_autoencoder`; not saved

    def __init__(self, encoder: Sequence[int], decoder: Sequence[int]) -> None:
        super().__init__()
        if (encoder[0], encoder[-1]) != (decoder[-1], decoder[0]):
            raise ValueError(f"decoder: expected widths from {encoder[-1]} to {encoder[0]}, got {tuple(decoder)}")
        self.encoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(encoder))
        self.decoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(decoder))
        self.register_buffer("range", torch.tensor([0.0, 1.0], dtype=torch.float64))

    def __repr__(self) -> str:
        widths = [self.dim, *(len(layer.bias) for layer in (*self.encoder, *self.decoder))]
        return f"Autoencoder({self.dim} channels to {self.latent} latents and back, widths {widths})"

    @property
    def dim(self) -> int:
        """Channels of a feature, D."""
        return int(self.encoder[0].weight.shape[1])

    @property
    def latent(self) -> int:
        """Channels of a latent, d."""
        return int(self.encoder[-1].weight.shape[0])

    @property
    def decoder_parameters(self) -> int:
        """Weights and biases of the decoder: counted as storage in Table 1 (831,744 for D = 512, d = 9)."""
        return sum(value.numel() for value in self.decoder.parameters())

    def encode(self, features: Tensor) -> Tensor:  # [..., D] -> [..., d] in [0, 1]
        """The latents of features. Only a feature's direction counts.

        Codewords of the fitted codebook fill [0, 1]; another feature's latent is clamped to it.
        """
        low, high = self.range.tolist()

        def encode_rows(rows: Tensor) -> Tensor:  # [n, D] -> [n, d]
            unit = unit_latents(mlp(self.encoder, unit_rows(rows)))
            return ((unit - low) / (high - low)).clamp(0, 1)

        return _by_chunk("features", features, self.dim, encode_rows)

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """The features of latents (Psi in Sec. 3.4), as unit rows. Differentiable."""
        return _by_chunk("latents", latents, self.latent, lambda rows: unit_rows(mlp(self.decoder, rows)))

    def forward(self, features: Tensor) -> Tensor:  # [..., D] -> [..., D]
        """Psi(E(f))."""
        return self.decode(self.encode(features))

    def to(self, *args: Any, **kwargs: Any) -> Autoencoder:
        """A copy, moved or converted, as all objects of kfgs have it; `torch.nn.Module.to` would change this one."""
        return nn.Module.to(deepcopy(self), *args, **kwargs)

    @classmethod
    def from_state_dict(cls, tensors: Mapping[str, Tensor]) -> Autoencoder:
        """An autoencoder from `state_dict`, with the widths of the weights. Other names are ignored.

        Raises:
            ValueError: if a tensor is missing, or layers do not fit together.
        """
        widths = []
        for name in ("encoder", "decoder"):
            count = sum(key.startswith(f"{name}.") and key.endswith(".weight") for key in tensors)
            weights = [tensors.get(f"{name}.{i}.weight") for i in range(max(count, 1))]
            if any(weight is None or weight.ndim != 2 for weight in weights):
                raise ValueError(f"tensors: expected {name}.0.weight [out, in] and so on, got {sorted(tensors)[:8]}...")
            widths.append([int(weights[0].shape[1]), *(int(weight.shape[0]) for weight in weights)])  # type: ignore[union-attr]
        with torch.device("meta"):
            made = cls(*widths)
        try:
            made.load_state_dict({name: tensors[name] for name in made.state_dict()}, assign=True)
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"tensors: expected those of Autoencoder.state_dict, got others ({error})") from error
        low, high = made.range.tolist()
        if not -torch.inf < low < high < torch.inf:
            raise ValueError(f"range: expected low < high, got {low:g}, {high:g}")
        return made.requires_grad_(False)


def mlp(layers: Iterable[nn.Module], rows: Tensor) -> Tensor:  # [n, in] -> [n, out]
    """Linear layers with ReLU between."""
    for i, layer in enumerate(layers):
        rows = layer(rows.relu() if i else rows)
    return rows


def unit_latents(latents: Tensor) -> Tensor:  # [n, d]
    """Unit length, unless there is only one channel."""
    return unit_rows(latents) if latents.shape[1] > 1 else latents


def _by_chunk(name: str, x: Tensor, width: int, function: Callable[[Tensor], Tensor]) -> Tensor:
    x = as_tensor(name, x, floating=True)
    if x.ndim < 1 or x.shape[-1] != width:
        raise ValueError(
            f"{name}: expected [..., {width}] (from the autoencoder's weights), got {tuple(x.shape)}; "
            "pass what belongs to the same scene"
        )
    rows = torch.cat([function(part) for part in x.reshape(-1, width).split(CHUNK)])  # one empty part of no rows
    return rows.reshape(*x.shape[:-1], rows.shape[1])
