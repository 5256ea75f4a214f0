"""What a Gaussian's latent means: how it is decoded, compared with texts, and how a rendered pixel gets its class.

`Linear` decodes the fused features of `uplift_maps`. The others are the three rows of Table 1. The class of a pixel:

| decoder | row | by default | with `paper` (Sec. 3.4 as printed) |
|---|---|---|---|
| `Linear` | - | most blended votes of its Gaussians (`divide_votes`) | class most similar to the blended feature |
| `Identity` | just decouple | class most similar to the blended feature | the same |
| `Codewords` | decouple+ADC | class most similar to the blended feature | class of the codeword nearest to it |
| `Autoencoded` | decouple+ADC+SC | class of the codeword with the nearest latent | blended latent decoded, then as above |

Blending is linear. So where a pixel's class follows from blended features, K numbers per Gaussian (`votes`) are blended in place
of the features, and the largest is kept while they are: nothing of [H, W, D] or [H, W, K] is in memory. Otherwise `votes` is
None: latents are blended, and `label_pixels` decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import torch
from torch import Tensor

from .._card import short_repr
from .._rows import EPS, check_directions, largest, row_norms, unit_rows
from ..labels.classify import pixel_codewords
from ..labels.scores import LOGIT_SCALE
from ..quant import Autoencoder, Codebook, LinearLatents
from ..splat.rasterize import Votes

CHUNK = 8192  # latents decoded at once: the decoder's widest layer then holds 32 MB
LEAST_SHARE = 1e-30
"""A smaller share of a vote counts as none: blended, it would be a denormal number, with which a CPU takes ten times as long."""
Ranks = tuple[Tensor, Tensor]  # [..., top] int64, [..., top]: the best classes and their scores; -1 and 0 for none


class Decoder(Protocol):
    """The meaning of d numbers per Gaussian (and per rendered pixel) in a teacher's space of D channels."""

    name: ClassVar[str]
    """For tables: the row of Table 1, or "fused"."""
    paper: bool
    """Whether pixels get their classes as Sec. 3.4 is printed; the table above has both rules."""

    @property
    def dim(self) -> int:
        """Channels of a feature, D."""

    @property
    def latent(self) -> int:
        """Channels of a latent, d."""
        return self.dim

    @property
    def parameters(self) -> int:
        """Numbers that decoding and labelling need, as Table 1 counts them."""
        return 0

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """Features in the teacher's space."""
        return latents

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:  # [N, d], [M, D] of length 1 -> [N, M]
        """The cosine of each Gaussian with each row; 0 for an all-zero latent."""

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:  # [N, d], [C, D] of length 1
        """What each Gaussian adds to the score of each class at a pixel; None if only `label_pixels` can tell."""
        return similarity_votes(latents, rows)

    def label_pixels(
        self,
        pixels: Tensor,  # [..., d] rendered latents
        rows: Tensor,  # [C, D] of length 1
        top: int,
        covered: Tensor,  # [...] bool, where anything is drawn
    ) -> Ranks:
        """The most similar classes of each pixel, the best first, and their cosines; -1 and 0 where nothing is known."""
        cosines = torch.cat([self.cosines(part, rows) for part in pixels.reshape(-1, self.latent).split(CHUNK)])
        scores, labels = cosines.sort(dim=1, descending=True, stable=True)  # ties go to the lowest class
        empty = ((row_norms(pixels) <= EPS) | ~covered)[..., None]
        labels, scores = (best[:, :top].reshape(*pixels.shape[:-1], top) for best in (labels, scores))
        return labels.masked_fill(empty, -1), scores.masked_fill(empty, 0)

    def to_tensors(self) -> dict[str, Tensor]:
        """What `make_decoder` reads."""
        return {}

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """On another device or in another dtype, as `Tensor.to`."""
        moved = {name: part.to(*args, **kwargs) for name, part in vars(self).items() if hasattr(part, "to")}
        this: Any = self
        return replace(this, **moved)


@dataclass(frozen=True, eq=False)
class Identity(Decoder):
    """Latents are the teacher's features themselves."""

    channels: int
    paper: bool = False
    name = "just decouple"

    @property
    def dim(self) -> int:
        return self.channels

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:
        check_directions("gaussians.features", latents)
        return torch.cat([unit_rows(part) @ rows.T for part in latents.split(CHUNK)])


@dataclass(frozen=True, eq=False)
class Linear(LinearLatents, Decoder):
    """Latents are linear in the feature, f = B z: a cosine is one product of d numbers, and a blend means what it shows."""

    paper: bool = False
    name = "fused"
    __repr__ = short_repr

    @property
    def parameters(self) -> int:
        return self.basis.numel()

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        if self.paper:
            return similarity_votes(latents, self.encode(rows))
        return divide_votes(self.cosines(latents, rows), latents.any(dim=1))

    def to_tensors(self) -> dict[str, Tensor]:
        return {"linear.basis": self.basis}


class _Quantised(Decoder):
    """A Gaussian has the cosines of its nearest codeword."""

    codebook: Codebook

    @property
    def dim(self) -> int:
        return self.codebook.dim

    @property
    def parameters(self) -> int:
        return self.codebook.codewords.numel()

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:
        per_codeword = self.codebook.unit.to(rows) @ rows.T  # [K, M]
        index = torch.cat([self.codebook.quantize(self.decode(part)) for part in latents.split(CHUNK)])
        return per_codeword[index] * latents.any(dim=1)[:, None]

    def codewords(self, pixels: Tensor, covered: Tensor) -> Tensor:  # [..., d], [...] bool -> [...] int64
        """The codeword of each rendered latent, -1 where nothing is known."""
        return pixel_codewords(pixels, self.codebook, covered=covered)

    def label_pixels(self, pixels: Tensor, rows: Tensor, top: int, covered: Tensor) -> Ranks:
        unit, index = self.codebook.unit, self.codewords(pixels, covered)
        scores, labels = (unit @ rows.T.to(unit)).sort(dim=1, descending=True, stable=True)  # [K, C]
        empty = (index < 0)[..., None]
        return labels[:, :top][index].masked_fill_(empty, -1), scores[:, :top][index].masked_fill_(empty, 0)

    def to_tensors(self) -> dict[str, Tensor]:
        return {"codebook.codewords": self.codebook.codewords}


@dataclass(frozen=True, eq=False)
class Codewords(_Quantised):
    """Latents are features near codewords of S (Sec. 3.3.1)."""

    codebook: Codebook
    paper: bool = False
    name = "decouple+ADC"

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        return None if self.paper else similarity_votes(latents, rows)

    def label_pixels(self, pixels: Tensor, rows: Tensor, top: int, covered: Tensor) -> Ranks:
        if self.paper:
            return super().label_pixels(pixels, rows, top, covered)
        return Identity(self.dim).label_pixels(pixels, rows, top, covered)


@dataclass(frozen=True, eq=False)
class Autoencoded(_Quantised):
    """Latents are codewords compressed by the autoencoder (Sec. 3.3.2).

    The codeword with the nearest latent is found 900 times cheaper than by decoding a pixel.
    """

    codebook: Codebook
    autoencoder: Autoencoder
    paper: bool = False
    name = "decouple+ADC+SC"

    def __post_init__(self) -> None:
        if self.autoencoder.dim != self.codebook.dim:
            got = f"{self.autoencoder.dim}; pass the autoencoder that was fitted to this codebook"
            raise ValueError(f"autoencoder: expected {self.codebook.dim} decoded channels (from codebook), got {got}")

    @property
    def latent(self) -> int:
        return self.autoencoder.latent

    @property
    def parameters(self) -> int:
        return self.autoencoder.decoder_parameters + self.codebook.codewords.numel()

    def decode(self, latents: Tensor) -> Tensor:
        return self.autoencoder.decode(latents)

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        return None

    def codewords(self, pixels: Tensor, covered: Tensor) -> Tensor:
        return pixel_codewords(pixels, self.codebook, self.autoencoder, exact=self.paper, covered=covered)

    def to_tensors(self) -> dict[str, Tensor]:
        weights = {f"autoencoder.{name}": value for name, value in self.autoencoder.state_dict().items()}
        return {"codebook.codewords": self.codebook.codewords, **weights}


def make_decoder(tensors: Mapping[str, Tensor], channels: int) -> Decoder:
    """The decoder of `Decoder.to_tensors`, for Gaussians with this many channels. Other names are ignored."""
    if "linear.basis" in tensors:
        return Linear(tensors["linear.basis"])
    if "codebook.codewords" not in tensors:
        return Identity(channels)
    codebook, prefix = Codebook(tensors["codebook.codewords"]), "autoencoder."
    weights = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
    return Autoencoded(codebook, Autoencoder.from_state_dict(weights)) if weights else Codewords(codebook)


def divide_votes(cosines: Tensor, known: Tensor) -> Votes:  # [N, C], [N] bool
    """Each Gaussian divides one vote among the classes: the softmax of 100 times the cosines, CLIP's scale.

    A class that no Gaussian prefers gets no vote: it would win pixels where it is second everywhere.
    """
    classes = torch.bincount(largest(cosines)[1][known], minlength=cosines.shape[1]).nonzero()[:, 0]
    shares = torch.softmax(cosines.index_select(1, classes).mul_(LOGIT_SCALE), dim=1) * known[:, None]
    return Votes(classes, torch.nn.functional.threshold(shares, LEAST_SHARE, 0, inplace=True))


def similarity_votes(features: Tensor, rows: Tensor) -> Votes:  # [N, d], [C, d]
    """Dot products with the classes: the largest of the blended ones is that of the blended feature.

    The same number is added for all classes, twice the feature's length: it changes no order, and makes all positive.
    """
    shares = features @ rows.T + 2 * row_norms(features)[:, None]
    return Votes(torch.arange(len(rows), device=shares.device), shares)
