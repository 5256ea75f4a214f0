"""kfgs as layers of a network, in kornia's conventions: modules over batches [B, C, H, W] that render, quantise and compress.

Each is the face of a function that kfgs itself uses, so that it gives the same numbers: `rasterize`, `nearest_rows` (Eq. 5),
`Autoencoder` (Eq. 10). They are differentiable, have a `state_dict`, and can be compiled (`torch.compile`).
"""

from __future__ import annotations

from copy import deepcopy
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ._check import check_shapes
from ._rows import unit_rows
from .cameras import Camera, Cameras
from .gaussians import Gaussians
from .quant import Autoencoder, Codebook
from .quant.codebook import nearest_rows
from .splat import Rendering, rasterize

__all__ = ["GaussianRenderer", "LatentAutoencoder", "VectorQuantizer"]


class Rendered(NamedTuple):
    """What B cameras see."""

    map: Tensor  # [B, D, H, W] features, or red, green, blue
    alpha: Tensor  # [B, 1, H, W] opacity in [0, 1)
    rendering: Rendering  # the same as [B, H, W, D] and [B, H, W], with the projected Gaussians

    @property
    def depth(self) -> Tensor:  # [B, 1, H, W]
        """The median depth of each pixel, world units; computed when it is asked for, without gradient. See `Rendering.depth`."""
        return self.rendering.depth[:, None]


class GaussianRenderer(nn.Module):
    """Draw Gaussians from a batch of cameras, as `rasterize` does: Eq. 3, or colours by Eq. 1.

    Differentiable in all tensors of the Gaussians, in the background, and in poses and intrinsics of the cameras. If one of
    those requires a gradient, kornia's projection is used, on a CPU several times slower than the compiled one.

    Example:
        >>> from kfgs.cameras import Camera, to_kornia
        >>> camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]]), 4, 4)
        >>> rows = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1), torch.tensor([0.5])
        >>> ball = Gaussians(*rows, features=torch.tensor([[1.0, 2.0, 3.0]]))
        >>> views = GaussianRenderer(engine="reference")(ball, to_kornia([camera, camera]))
        >>> views.map.shape, views.alpha.shape, views.depth[0, 0, 1].tolist()
        (torch.Size([2, 3, 4, 4]), torch.Size([2, 1, 4, 4]), [2.0, 2.0, 2.0, 2.0])
    """

    background: Tensor | None

    def __init__(self, *, background: Tensor | None = None, engine: str = "auto", near: float | None = None) -> None:
        """The options of `rasterize`. The background [D] is a buffer: it moves with the module and is in its `state_dict`."""
        super().__init__()
        self.register_buffer("background", background)
        self.engine, self.near = engine, near

    @torch.compiler.disable  # type: ignore[untyped-decorator]  # its kernels are compiled already
    def forward(self, gaussians: Gaussians, cameras: Cameras) -> Rendered:
        """Render the views of a kornia `PinholeCamera` of batch B, or of a list of cameras, all of one size."""
        cameras = [cameras] if isinstance(cameras, Camera) else cameras
        rendering = rasterize(gaussians, cameras, background=self.background, engine=self.engine, near=self.near)
        return Rendered(rendering.map.permute(0, 3, 1, 2), rendering.alpha[:, None], rendering)

    def extra_repr(self) -> str:
        """The options, as `torch.nn.Module` prints them."""
        return f"engine={self.engine!r}, near={self.near}"


class Quantized(NamedTuple):
    """A map in which every feature is a codeword."""

    map: Tensor  # [B, D, H, W]
    indices: Tensor  # [B, H, W] int64, which codeword: the index map M of Eq. 5


class VectorQuantizer(nn.Module):
    """A codebook as a layer: each pixel's feature becomes its most similar codeword (Eq. 5).

    The gradient of a quantised map goes to the features as if nothing had been quantised (straight-through), and to the
    codewords that were chosen. A loss on `map` alone therefore trains both; Eq. 6 is `kfgs.quant.fit_codebook`'s.

    Example:
        >>> layer = VectorQuantizer(Codebook(torch.tensor([[2.0, 0.0], [0.0, 3.0]])))
        >>> quantised = layer(torch.tensor([[1.0, 0.1], [0.2, 5.0]]).T[None, :, None])  # [1, 2, 1, 2]
        >>> quantised.indices.tolist(), quantised.map[0, :, 0, 1].tolist()
        ([[[0, 1]]], [0.0, 3.0])
    """

    def __init__(self, codebook: Codebook | Tensor) -> None:
        """`codebook`: a codebook of kfgs, or its codewords [K, D]; they are copied."""
        super().__init__()
        book = codebook if isinstance(codebook, Codebook) else Codebook(codebook)
        self.codewords = nn.Parameter(book.codewords.detach().clone())

    def forward(self, features: Tensor) -> Quantized:  # [B, D, H, W]
        """The quantised map and its indices. Ties go to the lowest index; an all-zero feature gets index 0."""
        sizes = check_shapes(("features", features, ("B", self.codewords.shape[1], "H", "W")))
        pixels = features.movedim(1, -1)  # [B, H, W, D]
        rows = pixels.detach().reshape(-1, self.codewords.shape[1]).to(self.codewords.dtype)
        with torch.autocast(features.device.type, enabled=False):  # half precision finds other codewords
            nearest = nearest_rows(rows, unit_rows(self.codewords.detach())).codeword
        indices = nearest.view(sizes["B"], sizes["H"], sizes["W"])
        straight = self.codewords[indices] + (pixels - pixels.detach())  # the bracket is 0, with a gradient of 1
        return Quantized(straight.movedim(-1, 1), indices)

    def decode(self, indices: Tensor) -> Tensor:  # [B, H, W] int64 -> [B, D, H, W]
        """The map of an index map, S[M]."""
        return self.codewords[indices].movedim(-1, 1)

    def codebook(self) -> Codebook:
        """The codewords as a codebook of kfgs, which `save`, `quantize_maps` and `fit_autoencoder` take."""
        return Codebook(self.codewords.detach().clone())


class LatentAutoencoder(nn.Module):
    """The scene's autoencoder (Eq. 10) over maps, with weights that train on.

    Features [B, D, H, W] become latents [B, d, H, W] in [0, 1] by E, and unit features again by Psi. The range of the latents
    is the one that `fit_autoencoder` froze; what leaves it is clamped and has no gradient there.

    Example:
        >>> layer = LatentAutoencoder(Autoencoder((8, 6, 3), (3, 6, 8)))
        >>> latents = layer.encode(torch.randn(2, 8, 4, 5))
        >>> latents.shape, layer.decode(latents).shape, sum(weight.numel() for weight in layer.parameters())
        (torch.Size([2, 3, 4, 5]), torch.Size([2, 8, 4, 5]), 155)
    """

    def __init__(self, autoencoder: Autoencoder) -> None:
        """`autoencoder`: what `fit_autoencoder` returns, or a new `Autoencoder(widths of E, widths of Psi)`; it is copied."""
        super().__init__()
        self.model = deepcopy(autoencoder).requires_grad_()

    def encode(self, features: Tensor) -> Tensor:  # [B, D, H, W] -> [B, d, H, W]
        """The latents of features (E)."""
        check_shapes(("features", features, ("B", self.model.dim, "H", "W")))
        return self.model.encode(features.movedim(1, -1)).movedim(-1, 1)

    def decode(self, latents: Tensor) -> Tensor:  # [B, d, H, W] -> [B, D, H, W]
        """The unit features of latents (Psi)."""
        check_shapes(("latents", latents, ("B", self.model.latent, "H", "W")))
        return self.model.decode(latents.movedim(1, -1)).movedim(-1, 1)

    def forward(self, features: Tensor) -> Tensor:  # [B, D, H, W] -> [B, D, H, W]
        """The features as they come back from their latents."""
        return self.decode(self.encode(features))

    def autoencoder(self) -> Autoencoder:
        """The autoencoder of kfgs with these weights, frozen: to `save`, or for the decoder of a field."""
        return deepcopy(self.model).requires_grad_(False)
