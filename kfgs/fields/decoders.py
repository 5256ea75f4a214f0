"""What a Gaussian's latent means: how it is decoded, compared with texts, and how a rendered pixel gets its class.

`Linear` decodes the fused features of `uplift_maps`. The others are the three rows of Table 1: `Identity` ("just decouple"),
`Codewords` ("decouple+ADC") and `Autoencoded` ("decouple+ADC+SC").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from .._rows import EPS, check_directions, row_norms, unit_rows
from ..labels import label_pixels
from ..quant import Autoencoder, Codebook, LinearLatents
from .votes import Votes, divide_votes, similarity_votes

CHUNK = 8192  # latents decoded at once: the decoder's widest layer then holds 32 MB


class Decoder(Protocol):
    """The meaning of d numbers per Gaussian (and per rendered pixel) in a teacher's space of D channels.

    With `paper`, pixels get their classes as Sec. 3.4 is printed: render the latent map, decode every pixel, quantise it with
    the codebook, look up. By default each decoder uses what is better or quicker and stated in its docstring.
    """

    name: ClassVar[str]
    """For tables: the row of Table 1, or "fused"."""
    paper: bool

    @property
    def dim(self) -> int:
        """Channels of a feature, D."""
        ...

    @property
    def latent(self) -> int:
        """Channels of a latent, d."""
        ...

    @property
    def parameters(self) -> int:
        """Numbers that decoding and labelling need, as Table 1 counts them."""
        ...

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """Features in the teacher's space."""
        ...

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:  # [N, d], [M, D] of length 1 -> [N, M]
        """The cosine of each Gaussian with each row; 0 for an all-zero latent."""
        ...

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:  # [N, d], [C, D] of length 1
        """What each Gaussian adds to the score of each class at a pixel; None if only `label_pixels` can tell."""
        ...

    def label_pixels(
        self,
        pixels: Tensor,  # [..., d] rendered latents
        rows: Tensor,  # [C, D] of length 1
        top: int = 1,
        covered: Tensor | None = None,  # [...] bool
    ) -> tuple[Tensor, Tensor]:  # [..., top] int64, [..., top]
        """The most similar classes of each pixel, the best first, and their cosines; -1 and 0 where nothing is known."""
        ...

    def to(self, *args: Any, **kwargs: Any) -> Decoder:
        """On another device or in another dtype, as `Tensor.to`."""
        ...

    def to_tensors(self) -> dict[str, Tensor]:
        """What `make_decoder` reads."""
        ...


@dataclass(frozen=True, eq=False)
class Identity:
    """Latents are the teacher's features themselves. A pixel takes the class most similar to its rendered feature."""

    latent: int
    paper: bool = False
    name: ClassVar[str] = "just decouple"
    parameters: ClassVar[int] = 0

    @property
    def dim(self) -> int:
        return self.latent

    def decode(self, latents: Tensor) -> Tensor:
        return latents

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:
        check_directions("gaussians.features", latents)
        return torch.cat([unit_rows(part) @ rows.T for part in latents.split(CHUNK)])

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        return similarity_votes(latents, rows)

    def label_pixels(
        self, pixels: Tensor, rows: Tensor, top: int = 1, covered: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        return _best(pixels, lambda part: unit_rows(part) @ rows.T, top, covered)

    def to(self, *args: Any, **kwargs: Any) -> Identity:
        return self

    def to_tensors(self) -> dict[str, Tensor]:
        return {}


@dataclass(frozen=True, eq=False)
class Linear:
    """Latents are linear in the feature, f = B z: a cosine is one product of d numbers, and a blend means what it shows.

    Each Gaussian divides one vote among the classes (`divide_votes`); a pixel takes the class with most blended votes. With
    `paper`, it takes the class most similar to the rendered feature.
    """

    latents: LinearLatents
    paper: bool = False
    name: ClassVar[str] = "fused"

    def __repr__(self) -> str:
        return f"Linear({self.latent} latents for {self.dim} channels)"

    @property
    def dim(self) -> int:
        return int(self.latents.basis.shape[0])

    @property
    def latent(self) -> int:
        return int(self.latents.basis.shape[1])

    @property
    def parameters(self) -> int:
        return self.latents.basis.numel()

    def decode(self, latents: Tensor) -> Tensor:
        return self.latents.decode(latents)

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:
        return unit_rows(latents) @ (rows @ self.latents.basis.to(rows)).T

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        if self.paper:
            return similarity_votes(latents, rows @ self.latents.basis.to(rows))
        return divide_votes(self.cosines(latents, rows), latents.any(dim=1))

    def label_pixels(
        self, pixels: Tensor, rows: Tensor, top: int = 1, covered: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        return _best(pixels, lambda part: self.cosines(part, rows), top, covered)

    def to(self, *args: Any, **kwargs: Any) -> Linear:
        return Linear(self.latents.to(*args, **kwargs), self.paper)

    def to_tensors(self) -> dict[str, Tensor]:
        return {"linear.basis": self.latents.basis}


@dataclass(frozen=True, eq=False)
class Codewords:
    """Latents are features near codewords of S (Sec. 3.3.1). A Gaussian has the cosines of its nearest codeword.

    A pixel takes the class most similar to its rendered feature; with `paper`, that of the nearest codeword.
    """

    codebook: Codebook
    paper: bool = False
    name: ClassVar[str] = "decouple+ADC"

    @property
    def dim(self) -> int:
        return self.codebook.dim

    @property
    def latent(self) -> int:
        return self.codebook.dim

    @property
    def parameters(self) -> int:
        return self.codebook.codewords.numel()

    def decode(self, latents: Tensor) -> Tensor:
        return latents

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:
        return _quantised_cosines(self, self.codebook, latents, rows)

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        return None if self.paper else similarity_votes(latents, rows)

    def label_pixels(
        self, pixels: Tensor, rows: Tensor, top: int = 1, covered: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        if not self.paper:
            return _best(pixels, lambda part: unit_rows(part) @ rows.T, top, covered)
        index = label_pixels(pixels, self.codebook, torch.arange(self.codebook.size), covered=covered)
        return _look_up(index, self.codebook, rows, top)

    def to(self, *args: Any, **kwargs: Any) -> Codewords:
        return Codewords(self.codebook.to(*args, **kwargs), self.paper)

    def to_tensors(self) -> dict[str, Tensor]:
        return {f"codebook.{name}": value for name, value in self.codebook.state_dict().items()}


@dataclass(frozen=True, eq=False)
class Autoencoded:
    """Latents are codewords compressed by the autoencoder (Sec. 3.3.2). A Gaussian has the cosines of its nearest codeword.

    A pixel takes the codeword with the latent nearest to the rendered one, which is 900 times cheaper than decoding; with
    `paper`, it is decoded by Psi and quantised.
    """

    codebook: Codebook
    autoencoder: Autoencoder
    paper: bool = False
    name: ClassVar[str] = "decouple+ADC+SC"

    def __post_init__(self) -> None:
        if self.autoencoder.dim != self.codebook.dim:
            raise ValueError(
                f"autoencoder: expected {self.codebook.dim} decoded channels (from codebook), got {self.autoencoder.dim}; "
                "pass the autoencoder that was fitted to this codebook"
            )

    @property
    def dim(self) -> int:
        return self.codebook.dim

    @property
    def latent(self) -> int:
        return self.autoencoder.latent

    @property
    def parameters(self) -> int:
        return self.autoencoder.decoder_parameters + self.codebook.codewords.numel()

    def decode(self, latents: Tensor) -> Tensor:
        return self.autoencoder.decode(latents)

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:
        return _quantised_cosines(self, self.codebook, latents, rows)

    def votes(self, latents: Tensor, rows: Tensor) -> Votes | None:
        return None

    def label_pixels(
        self, pixels: Tensor, rows: Tensor, top: int = 1, covered: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        index = label_pixels(
            pixels,
            self.codebook,
            torch.arange(self.codebook.size),
            self.autoencoder,
            decode="exact" if self.paper else "latent",
            covered=covered,
        )
        return _look_up(index, self.codebook, rows, top)

    def to(self, *args: Any, **kwargs: Any) -> Autoencoded:
        return Autoencoded(self.codebook.to(*args, **kwargs), self.autoencoder.to(*args, **kwargs), self.paper)

    def to_tensors(self) -> dict[str, Tensor]:
        weights = {f"autoencoder.{name}": value for name, value in self.autoencoder.state_dict().items()}
        return {"codebook.codewords": self.codebook.codewords, **weights}


def make_decoder(tensors: Mapping[str, Tensor], channels: int) -> Decoder:
    """The decoder of `Decoder.to_tensors`, for Gaussians with so many channels. Other names are ignored."""
    parts: dict[str, dict[str, Tensor]] = {"linear": {}, "codebook": {}, "autoencoder": {}}
    for name, value in tensors.items():
        kind, _, rest = name.partition(".")
        if kind in parts:
            parts[kind][rest] = value
    if parts["linear"]:
        return Linear(LinearLatents.from_state_dict(parts["linear"]))
    if not parts["codebook"]:
        return Identity(channels)
    codebook = Codebook.from_state_dict(parts["codebook"])
    if not parts["autoencoder"]:
        return Codewords(codebook)
    return Autoencoded(codebook, Autoencoder.from_state_dict(parts["autoencoder"]))


def _quantised_cosines(decoder: Decoder, codebook: Codebook, latents: Tensor, rows: Tensor) -> Tensor:  # [N, M]
    """The cosines of each latent's nearest codeword; 0 for an all-zero latent."""
    per_codeword = codebook.unit.to(rows) @ rows.T  # [K, M]
    index = torch.cat([codebook.quantize(decoder.decode(part)) for part in latents.split(CHUNK)])
    return per_codeword[index] * latents.any(dim=1)[:, None]


def _best(pixels: Tensor, compare: Any, top: int, covered: Tensor | None) -> tuple[Tensor, Tensor]:
    """The `top` largest cosines of each pixel; ties go to the lowest class."""
    cosines = torch.cat([compare(part) for part in pixels.reshape(-1, pixels.shape[-1]).split(CHUNK)])
    scores, labels = cosines.sort(dim=1, descending=True, stable=True)
    empty = (row_norms(pixels) <= EPS) if covered is None else (row_norms(pixels) <= EPS) | ~covered
    shape = *pixels.shape[:-1], top
    labels, scores = labels[:, :top].reshape(shape), scores[:, :top].reshape(shape)
    return labels.masked_fill(empty[..., None], -1), scores.masked_fill(empty[..., None], 0)


def _look_up(index: Tensor, codebook: Codebook, rows: Tensor, top: int) -> tuple[Tensor, Tensor]:
    """The best classes of each pixel's codeword, given its index, -1 for none."""
    similarity = codebook.unit @ rows.T.to(codebook.unit)  # [K, C]
    scores, labels = similarity.sort(dim=1, descending=True, stable=True)
    empty = (index < 0)[..., None]
    return labels[:, :top][index].masked_fill_(empty, -1), scores[:, :top][index].masked_fill_(empty, 0)
