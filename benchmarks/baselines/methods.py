"""Gaussians with latents and a decoder of pixels: what every baseline becomes when it is finished."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from kfgs._rows import unit_rows
from kfgs.cameras import Camera
from kfgs.evaluation import Method, View, label_view
from kfgs.fields.decoders import divide_votes
from kfgs.gaussians import Gaussians
from kfgs.splat import Rendering, rasterize
from kfgs.splat.rasterize import rank_votes

CHUNK = 16_384  # pixels decoded at once


class Decoder(Protocol):
    """From rendered latents to the teacher's space."""

    def features(self, latents: Tensor) -> Tensor:  # [n, d] -> [n, D]
        """The features of latents, of any length."""
        ...

    def scores(self, latents: Tensor, text: Tensor) -> Tensor:  # [n, d], [K, D] -> [n, K]
        """Their products with unit rows: the cosines, up to a positive factor for each latent."""
        ...

    def to(self, device: torch.device) -> Decoder:
        """The decoder on a device."""
        ...


@dataclass(frozen=True, eq=False)
class LinearDecoder:
    """f = A z + b. Rendering is linear too, so a view is labelled from K rendered scores; no feature is needed."""

    matrix: Tensor | None = None  # A [D, d]; None = identity
    bias: Tensor | None = None  # b [D]; None = 0

    def features(self, latents: Tensor) -> Tensor:  # [n, d] -> [n, D]
        """A z + b."""
        found = latents if self.matrix is None else latents @ self.matrix.T
        return found if self.bias is None else found + self.bias

    def scores(self, latents: Tensor, text: Tensor) -> Tensor:  # [n, d], [K, D] -> [n, K]
        """(A z + b) . t, without A z."""
        rows = text if self.matrix is None else text @ self.matrix  # [K, d]
        found = latents @ rows.T
        return found if self.bias is None else found + text @ self.bias

    def to(self, device: torch.device) -> LinearDecoder:
        """Matrix and bias on a device."""
        return LinearDecoder(*(None if value is None else value.to(device) for value in (self.matrix, self.bias)))


@dataclass(frozen=True, eq=False)
class RenderedMethod:
    """A `kfgs.evaluation.Method` that renders latents and decodes each pixel; also a `Labeller`."""

    name: str
    gaussians: Gaussians
    """What is splatted is in `features`."""
    decoder: Decoder
    known: Tensor | None = None  # [N] bool, which Gaussians have learnt something; None = all that are not zero
    levels: int = 1

    def to(self, device: torch.device) -> RenderedMethod:
        """A copy on a device."""
        known = None if self.known is None else self.known.to(device)
        decoder = deepcopy(self.decoder).to(device)  # a module moves itself
        return replace(self, gaussians=self.gaussians.to(device), decoder=decoder, known=known)

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        """The map of latents, with its opacity."""
        return rasterize(self.gaussians, camera)

    @torch.no_grad()
    def cosines(self, view: View, text: Tensor) -> Tensor:  # [K, D] unit rows -> [1, H, W, K]
        """The cosine of each pixel's decoded feature with the rows; NaN where nothing was drawn."""
        rendering = self.render(view.camera)
        parts = rendering.map.flatten(0, 1).split(CHUNK)
        found = torch.cat([unit_rows(self.decoder.features(part)) @ text.T for part in parts])
        found = found.view(*rendering.alpha.shape, len(text))
        return found.masked_fill((rendering.alpha <= 0)[..., None], torch.nan)[None]

    @torch.no_grad()
    def gaussian_cosines(self, text: Tensor) -> Tensor:  # [K, D] unit rows -> [1, N, K]
        """The cosine of each Gaussian's own decoded feature; NaN for those that have learnt nothing."""
        own = self.gaussians.features
        assert own is not None
        found = torch.cat([unit_rows(self.decoder.features(part)) @ text.T for part in own.split(CHUNK)])
        known = own.any(dim=1) if self.known is None else self.known
        return found.masked_fill(~known[:, None], torch.nan)[None]

    @torch.no_grad()
    def labels(self, view: View, text: Tensor) -> Tensor:  # [K, D] unit rows -> [H, W] int64
        """The row of largest cosine at each pixel, -1 where nothing was drawn: the arg-max of `cosines`, found faster."""
        if isinstance(self.decoder, LinearDecoder):
            return self._linear_labels(self.decoder, view.camera, text)
        rendering = self.render(view.camera)
        parts = rendering.map.flatten(0, 1).split(CHUNK)
        found = torch.cat([self.decoder.scores(part, text).argmax(dim=1) for part in parts])
        return found.view(rendering.alpha.shape).masked_fill(rendering.alpha <= 0, -1)

    def _linear_labels(self, decoder: LinearDecoder, camera: Camera, text: Tensor) -> Tensor:
        own = self.gaussians.features
        assert own is not None
        products = LinearDecoder(decoder.matrix).scores(own, text).contiguous()
        rendering = rasterize(self.gaussians.replace(features=products), camera)
        scores = rendering.map if decoder.bias is None else rendering.map + text @ decoder.bias
        return scores.argmax(dim=2).masked_fill(rendering.alpha <= 0, -1)


class LabelMaps:
    """The label maps of a method for some classes, each made once however often it is asked for; a `Method` and a `Labeller`.

    Args:
        method: what is asked.
        text: the classes, unit rows [K, D]; other rows than these are an error.
        votes: let the Gaussians vote, as kfgs's default field does: each gives its softmax of 100 cosines to its pixels.
    """

    levels = 1

    def __init__(self, method: Method, text: Tensor, *, votes: bool = False) -> None:
        assert method.gaussians is not None
        self.method, self.text, self.name, self.gaussians = method, text, method.name, method.gaussians
        self._votes = None
        if votes:
            cosines = method.gaussian_cosines(text)[0]
            self._votes = divide_votes(cosines.nan_to_num(), ~cosines.isnan().any(dim=1))
        self._made: dict[tuple[str, tuple[int, int]], Tensor] = {}

    def labels(self, view: View, text: Tensor) -> Tensor:  # [K, D] unit rows -> [H, W] int64
        """The class of each pixel, -1 where nothing was drawn."""
        if text.shape != self.text.shape or not torch.allclose(text, self.text, atol=1e-5):
            raise ValueError("text: expected the classes that these maps are of, got other rows; make maps for them")
        key = view.stem, view.camera.size
        if key not in self._made:
            self._made[key] = self._label(view)
        return self._made[key]

    def _label(self, view: View) -> Tensor:
        if self._votes is None:
            return label_view(self.method, view, self.text)
        return rank_votes(self.gaussians, view.camera, self._votes).labels[..., 0]

    def cosines(self, view: View, text: Tensor) -> Tensor:  # [K, D] -> [1, H, W, K]
        """Those of the method."""
        return self.method.cosines(view, text)

    def gaussian_cosines(self, text: Tensor) -> Tensor:  # [K, D] -> [1, N, K]
        """Those of the method."""
        return self.method.gaussian_cosines(text)
