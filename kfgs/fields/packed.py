"""Pack a fused field into few bytes: round to whole numbers of a fixed precision, and compress these losslessly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import zstandard
from safetensors.torch import load, save
from torch import Tensor

from ..formats.smallest_three import pack_smallest_three, unpack_smallest_three
from ..gaussians import Gaussians
from ..quant import LinearLatents
from .semantic_field import SemanticField

STEP = 1 / 48
"""Of the latents, as a share of a unit feature: rounding then turns a feature of 20 latents by about 1.5 degrees."""
LEVEL = 19  # of zstd: the best compression that takes only seconds
LIMIT = 1 << 30  # bytes that a packed field may unpack to


def pack_field(field: SemanticField) -> bytes:
    """The geometry and the latents of a fused field, rounded and compressed.

    Means have 16 bits an axis over the cloud's box, log-scales and opacities 8 bits, the rotation the three smaller
    parts of its quaternion with 8 bits each, latents multiples of `STEP` in 8 bits, the basis half precision.

    Raises:
        ValueError: if the field is not a fused one.
    """
    if field.method != "fused" or field.linear is None:
        raise ValueError(f"field: expected a fused one, got {field.method!r}; fit it with method 'fuse', or uplift it")
    if len(field) == 0:
        raise ValueError("field: expected at least one Gaussian, got none; there is nothing to pack")
    cloud = field.gaussians
    means, mean_range = _to_range(cloud.means, 65_535)
    scales, scale_range = _to_range(cloud.scales.log(), 255)
    largest_part, small = pack_smallest_three(cloud.quats, 255)
    largest = float(field.features.abs().max())
    step = max(STEP, largest / 127)
    columns = {
        "means": (means - 32_768).to(torch.int16),
        "scales": scales.to(torch.uint8),
        "quats": torch.from_numpy(np.concatenate([largest_part, small], axis=1)).to(torch.uint8),
        "opacities": (255 * cloud.opacities).round().to(torch.uint8),
        "latents": (field.features / step).round().to(torch.int8),
        "basis": field.linear.basis.half(),
        "ranges": torch.stack([*mean_range, *scale_range]).float(),
        "step": torch.tensor(step),
    }
    # column by column compresses better than Gaussian by Gaussian
    planes = {name: value.T.contiguous() if value.ndim == 2 else value for name, value in columns.items()}
    return zstandard.ZstdCompressor(level=LEVEL).compress(save(planes))


def unpack_field(data: bytes) -> SemanticField:
    """Unpack the result of `pack_field`: a field without cameras and reliability. A ValueError for other bytes."""
    try:
        if zstandard.get_frame_parameters(data).content_size > LIMIT:
            raise ValueError(f"it would unpack to more than {LIMIT} bytes")
        planes = load(zstandard.ZstdDecompressor().decompress(data, max_output_size=LIMIT))
        columns = {name: value.T if value.ndim == 2 else value for name, value in planes.items()}
        low, high, small, large = columns["ranges"]
        quats = columns["quats"].numpy()
        cloud = Gaussians(
            means=_from_range(columns["means"].float() + 32_768, low, high, 65_535),
            quats=unpack_smallest_three(quats[:, 0].astype(np.int64), quats[:, 1:].astype(np.float32), 255),
            scales=_from_range(columns["scales"].float(), small, large, 255).exp(),
            opacities=(columns["opacities"].float() / 255).clamp(1e-4, 1 - 1e-4),
            features=columns["latents"].float() * columns["step"],
        )
        basis = torch.linalg.qr(columns["basis"].double())
        signs = torch.sign(basis.R.diagonal())
    except Exception as error:
        raise ValueError(
            f"data: expected a packed field, but it cannot be read ({error}); pack one with pack_field"
        ) from error
    return SemanticField(cloud, linear=LinearLatents((basis.Q * signs).float()))


def rounded(field: SemanticField) -> SemanticField:
    """A fused field with its values rounded as by packing and unpacking; its other parts stay."""
    back = unpack_field(pack_field(field))
    return replace(field, gaussians=back.gaussians, linear=back.linear)


def _to_range(values: Tensor, most: int) -> tuple[Tensor, tuple[Tensor, Tensor]]:  # [N, 3]
    low, high = values.amin(0), values.amax(0)
    return ((values - low) / (high - low).clamp_min(1e-20) * most).round(), (low, high)


def _from_range(values: Tensor, low: Tensor, high: Tensor, most: int) -> Tensor:  # [N, 3]
    return low + values * (high - low) / most
