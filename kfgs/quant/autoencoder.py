"""The scene's autoencoder of Sec. 3.3.2 as it is used: two small networks without state or mode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import reading
from .._check import as_tensor, check_range, check_shapes, moved_to
from .._rows import unit_rows
from ._store import read_tensors, write_tensors

Layer = tuple[Tensor, Tensor]  # weight [out, in], bias [out]


@dataclass(frozen=True, eq=False)
class Autoencoder:
    """Encoder E and decoder Psi of Eq. 10: D channels to d latents and back.

    Both are linear layers with ReLU between. The encoder was trained with batch normalisation; when fitting ended, its
    statistics over the whole codebook were folded into the linear layers, and the range of the latents was frozen. So
    each row is treated alone: the latent of a codeword does not depend on what else is in the batch, and there is no
    training mode to forget.

    **Convention**: a latent has unit length and is then mapped from [low, high] to [0, 1], the same for all channels.
    (A single channel keeps its length: a unit scalar would only say -1 or 1, and have no gradient to learn from.)
    """

    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]
    low: float
    high: float

    def __post_init__(self) -> None:
        check_range("high", self.high, self.low, closed=(False, True))
        layers = [("encoder", i, layer) for i, layer in enumerate(self.encoder)]
        layers += [("decoder", i, layer) for i, layer in enumerate(self.decoder)]
        width: Any = "in"
        for name, i, (weight, bias) in layers:
            check_shapes((f"{name}[{i}] weight", weight, f"out {width}"), (f"{name}[{i}] bias", bias, "out"))
            width = int(weight.shape[0])
        if width != self.dim:
            raise ValueError(f"decoder: expected {self.dim} output channels (the encoder's input), got {width}")

    def __repr__(self) -> str:
        widths = [self.dim, *(len(bias) for _, bias in (*self.encoder, *self.decoder))]
        return f"Autoencoder({self.dim} channels to {self.latent} latents and back, widths {widths})"

    @property
    def dim(self) -> int:
        """Channels of a feature, D."""
        return int(self.encoder[0][0].shape[1])

    @property
    def latent(self) -> int:
        """Channels of a latent, d."""
        return int(self.encoder[-1][0].shape[0])

    @property
    def decoder_parameters(self) -> int:
        """Weights and biases of the decoder: counted as storage in Table 1 (831,744 for D = 512, d = 9)."""
        return sum(weight.numel() + bias.numel() for weight, bias in self.decoder)

    def encode(
        self,
        features: Tensor,  # [..., D]
        *,
        chunk: int = 16_384,
    ) -> Tensor:  # [..., d] in [0, 1]
        """The latents of features, at most `chunk` rows at a time. Only a feature's direction counts.

        Codewords of the fitted codebook fill [0, 1]; another feature's latent is clamped to it.
        """
        return self._by_chunk("features", features, self.dim, chunk, self._encode)

    def decode(
        self,
        latents: Tensor,  # [..., d]
        *,
        chunk: int = 16_384,
    ) -> Tensor:  # [..., D]
        """The features of latents (Psi in Sec. 3.4), as unit rows, at most `chunk` at a time. Differentiable."""
        return self._by_chunk("latents", latents, self.latent, chunk, lambda rows: unit_rows(mlp(self.decoder, rows)))

    def to(self, *args: Any, **kwargs: Any) -> Autoencoder:
        """Move or convert the weights as `Tensor.to` does."""
        encoder, decoder = (
            tuple((moved_to(weight, *args, **kwargs), moved_to(bias, *args, **kwargs)) for weight, bias in layers)
            for layers in (self.encoder, self.decoder)
        )
        return Autoencoder(encoder, decoder, self.low, self.high)

    def to_tensors(self) -> dict[str, Tensor]:
        """The tensors that `from_tensors` reads: `<network>.<layer>.weight|bias` and `range` [2]."""
        tensors = {"range": torch.tensor([self.low, self.high], dtype=torch.float64)}
        for name, layers in (("encoder", self.encoder), ("decoder", self.decoder)):
            for i, (weight, bias) in enumerate(layers):
                tensors |= {f"{name}.{i}.weight": weight, f"{name}.{i}.bias": bias}
        return tensors

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> Autoencoder:
        """An autoencoder from the tensors of `to_tensors`, with the widths of the weights. Other names are ignored.

        Raises:
            ValueError: if a tensor is missing, or layers do not fit together.
        """
        try:
            low, high = tensors["range"].tolist()
            encoder, decoder = (
                tuple(
                    (tensors[f"{name}.{i}.weight"], tensors[f"{name}.{i}.bias"])
                    for i in range((sum(key.startswith(f"{name}.") for key in tensors) + 1) // 2 or 1)
                )
                for name in ("encoder", "decoder")
            )
        except KeyError as error:
            raise ValueError(
                f"tensors: expected the name {error}, got {sorted(tensors)[:8]}...; use Autoencoder.to_tensors"
            ) from None
        return Autoencoder(encoder, decoder, low, high)

    def save(self, path: str | Path) -> None:
        """Write the weights and the range to a .safetensors file."""
        write_tensors(path, self.to_tensors(), kind="autoencoder")

    @staticmethod
    def load(path: str | Path) -> Autoencoder:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not an autoencoder of kfgs.
        """
        tensors = read_tensors(path, kind="autoencoder")
        with reading(path, "an autoencoder of kfgs"):
            return Autoencoder.from_tensors(tensors)

    def _encode(self, rows: Tensor) -> Tensor:  # [n, D] -> [n, d]
        unit = unit_latents(mlp(self.encoder, unit_rows(rows)))
        return ((unit - self.low) / (self.high - self.low)).clamp(0, 1)

    def _by_chunk(self, name: str, x: Tensor, width: int, chunk: int, function: Any) -> Tensor:
        x = as_tensor(name, x, floating=True)
        if x.ndim < 1 or x.shape[-1] != width:
            raise ValueError(
                f"{name}: expected [..., {width}] (from the autoencoder's weights), got {tuple(x.shape)}; "
                "pass what belongs to the same scene"
            )
        check_range("chunk", chunk, 1)
        rows = x.reshape(-1, width)
        parts = [function(part) for part in rows.split(chunk)]  # split gives one empty part of no rows
        return torch.cat(parts).reshape(*x.shape[:-1], -1 if rows.shape[0] else parts[0].shape[1])


def mlp(layers: Sequence[Layer], rows: Tensor) -> Tensor:  # [n, in] -> [n, out]
    """Linear layers with ReLU between."""
    for i, (weight, bias) in enumerate(layers):
        rows = torch.nn.functional.linear(rows.relu() if i else rows, weight, bias)
    return rows


def unit_latents(latents: Tensor) -> Tensor:  # [n, d]
    """Unit length, unless there is only one channel."""
    return unit_rows(latents) if latents.shape[1] > 1 else latents
