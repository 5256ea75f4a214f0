"""gsplat beside kfgs's engine on a GPU, through its public function `gsplat.rasterization` alone.

It projects, bins and composites in one call, so it has a whole frame and a whole step, and no compositing by itself. With
`packed` it keeps what it projected for the visible Gaussians only: less memory, and sometimes less time. Both are measured.
More than 32 channels are rendered in rounds of 32 (its default).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from engines_runners import Inputs

NAMES = "gsplat", "gsplat packed"


@cache
def fault() -> str | None:
    """Why gsplat cannot be measured, in one line; None if it renders. Its first call may compile for minutes."""
    if not torch.cuda.is_available():
        return "it runs on CUDA only"
    try:
        _render(_one_gaussian(), torch.eye(4), torch.eye(3), (16, 16), 0.01, packed=False)
    except ImportError as error:
        return f"{error}; pip install gsplat"
    except Exception as error:  # its kernels are compiled at first use: whatever the compiler says
        return f"it does not render: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
    return None


def calls(name: str, inputs: Inputs) -> dict[str, Callable[[], Any]]:
    """`frame` and `step` of a case, as in `engines_runners.calls`."""
    cloud, camera = inputs.gaussians, inputs.camera
    tensors = cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.features
    leaves = [value.detach().clone().requires_grad_() for value in tensors]
    view = camera.viewmat, camera.K, (camera.width, camera.height), camera.near
    packed = name == "gsplat packed"

    def frame() -> Tensor:
        with torch.no_grad():
            return _render(leaves, *view, packed=packed)[0]

    def step() -> Any:
        outputs = _render(leaves, *view, packed=packed)
        return torch.autograd.grad(outputs, leaves, (inputs.grad_maps, inputs.grad_alphas))

    return {"frame": frame, "step": step}


def _render(
    tensors: list[Tensor],  # means [N, 3], quats [N, 4], scales [N, 3], opacities [N], features [N, D]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    size: tuple[int, int],  # width, height
    near: float,
    *,
    packed: bool,
) -> tuple[Tensor, Tensor]:  # [H, W, D], [H, W]
    """One view of some Gaussians; its low-pass filter is kfgs's by default (0.3 pixels squared)."""
    from gsplat import rasterization

    means, quats, scales, opacities, features = tensors
    maps, alphas, _ = rasterization(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=features,
        viewmats=viewmat.to(means)[None],
        Ks=K.to(means)[None],
        width=size[0],
        height=size[1],
        near_plane=near,
        packed=packed,
    )
    return maps[0], alphas[0, ..., 0]


def _one_gaussian() -> list[Tensor]:
    """A Gaussian in front of the camera, on the current GPU."""
    rows = [[0.0, 0.0, 2.0]], [[1.0, 0.0, 0.0, 0.0]], [[0.1, 0.1, 0.1]], [0.5], [[1.0, 2.0, 3.0]]
    return [torch.tensor(values, device="cuda") for values in rows]
