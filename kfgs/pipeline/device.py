"""Where a field is trained: the GPU if there is one, unless told otherwise."""

from __future__ import annotations

import torch

from ..splat import available_engines


def training_device(device: str | torch.device = "auto") -> torch.device:
    """The device that a name stands for.

    Args:
        device: `auto` takes CUDA if torch sees it and an engine runs on it, else the CPU; `cpu`, `cuda`, `cuda:1`.

    Raises:
        ValueError: if it is no device, or a GPU that is not there.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() and available_engines("cuda") else "cpu")
    try:
        chosen = torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"device: expected auto, cpu or cuda, got {device!r}; name one of them") from error
    if chosen.type not in ("cpu", "cuda"):
        raise ValueError(f"device: expected auto, cpu or cuda, got {device!r}; engines run on these only")
    if chosen.type == "cuda" and (chosen.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"device: expected a GPU that torch sees ({torch.cuda.device_count()} are there), got {device!r}; "
            "use cpu, or install a torch for CUDA"
        )
    return chosen
