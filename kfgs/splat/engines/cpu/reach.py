"""How far from its mean a Gaussian shows, in terms of its quadratic form."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..contract import ALPHA_MIN
from .threads import run_bands

_PIECE = 16384
"""Below the size at which torch wakes its own threads, which wait for each other; the bands' threads do not."""


@torch.no_grad()
def find_reach(opacities: Tensor) -> np.ndarray:  # [M] -> [M]
    """The largest d^T C d at which opacity * exp(-0.5 d^T C d) >= ALPHA_MIN; not positive for a fainter Gaussian.

    torch's logarithm, so that it is the one of `kfgs.splat.project` and `kfgs.splat.tiles` to the bit.
    """
    pieces = opacities.detach().split(_PIECE)
    out = np.empty(len(opacities), opacities.detach().numpy().dtype)

    def fill(band: int) -> None:
        out[band * _PIECE : (band + 1) * _PIECE] = torch.log(pieces[band] / ALPHA_MIN).mul_(2).numpy()

    run_bands(fill, len(pieces))
    return out
