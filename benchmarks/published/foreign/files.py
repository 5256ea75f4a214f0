"""Files of other programs, read as data: tensors in checkpoints, found by where they stand and by their shapes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kfgs._arrays import FileError, plain_tensor, read_torch
from kfgs.formats.table import numbered_files
from kfgs.gaussians import Gaussians


def finite_tensor(path: Path, name: str, value: object) -> Tensor:
    """A dense tensor of a file in float32; a FileError if it is something else, or not all of its numbers are finite."""
    values = plain_tensor(path, name, value)
    if not bool(torch.isfinite(values).all()):
        raise FileError(f"{path}: expected finite numbers for {name}, got NaN or infinity; did the training diverge?")
    return values


def read_state(path: Path, expected: str) -> dict[str, Tensor]:
    """The tensors of a state dict by name; one that lies in `state_dict` or `module_state_dict` is taken out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds something else.
    """
    top = read_torch(path, expected)
    for name in ("module_state_dict", "state_dict"):
        if isinstance(top, Mapping) and isinstance(top.get(name), Mapping):
            top = top[name]
    if not isinstance(top, Mapping) or not top:
        raise ValueError(f"{path}: expected {expected}, got {type(top).__name__}; give the file with the weights")
    names = [name for name, value in top.items() if isinstance(value, Tensor)]
    return {str(name): finite_tensor(path, str(name), top[name]) for name in names}


def read_capture(
    path: Path, extra: Mapping[str, int], order: str = "xyz dc rest scales quats opacity"
) -> dict[str, Any]:
    """The values that a training script of the 3DGS family keeps: a tuple in a fixed order, and the step.

    From formats.md: (12 values, step), and that scales are logarithms, opacities logits, quaternions w, x, y, z (of the PLY;
    a checkpoint holds what the PLY is written from). The order is our reading, confirmed by no sample; wrong shapes are
    refused.

    Args:
        path: `chkpnt30000.pth`.
        extra: values besides the Gaussians, by their place in the tuple.
        order: what follows the SH degree.

    Returns:
        `gaussians` and the values of `extra`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds something else.
    """
    expected = "a checkpoint (values, step) of the 3DGS family"
    top = read_torch(path, expected)
    if not (isinstance(top, tuple | list) and len(top) == 2 and isinstance(top[0], tuple | list)):
        raise ValueError(f"{path}: expected {expected}, got {_kind(top)}; give chkpnt<step>.pth")
    values = top[0]
    if len(values) == 12 and extra:
        raise ValueError(
            f"{path}: expected a checkpoint with {', '.join(extra)}, got one of the colours alone (12 values); give the "
            "checkpoint of the run that trained the features"
        )
    if len(values) <= max([len(order.split()), *extra.values()]):
        raise ValueError(f"{path}: expected {expected} with {', '.join(extra)}, got {len(values)} values")
    raw = {name: finite_tensor(path, name, values[i]) for i, name in enumerate(order.split(), 1) if name != "-"}
    found = {name: finite_tensor(path, name, values[place]) for name, place in extra.items()}
    return {"gaussians": _activate(path, raw), **found}


def _activate(path: Path, raw: dict[str, Tensor]) -> Gaussians:
    N = len(raw["xyz"])
    shapes = {"xyz": (N, 3), "dc": (N, 1, 3), "scales": (N, 3), "quats": (N, 4), "opacity": (N, 1)}
    for name, shape in shapes.items():
        if tuple(raw[name].shape) != shape:
            raise ValueError(
                f"{path}: expected {name} {list(shape)}, got {list(raw[name].shape)}; is this another program's checkpoint?"
            )
    try:
        sh = torch.cat([raw["dc"], raw["rest"]], 1)
        return Gaussians(raw["xyz"], raw["quats"], raw["scales"].exp(), raw["opacity"][:, 0].sigmoid(), sh=sh)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error


def check_rows(path: Path, name: str, values: Tensor, count: int) -> None:
    """Raise a ValueError unless there is a row per Gaussian."""
    if values.ndim != 2 or len(values) != count or values.shape[1] == 0:
        raise ValueError(f"{path}: expected {name} [{count}, d], one row per Gaussian, got {list(values.shape)}")


def find_numbered(folder: Path, pattern: str, step: int | None, what: str) -> Path:
    """The file of a step, or of the last one.

    Args:
        folder: where to look.
        pattern: a glob with one `*`, which stands for the step.
        step: the number; None: the highest.
        what: for the message.

    Raises:
        FileNotFoundError: if there is none.
    """
    files = numbered_files(folder, pattern)
    if not files or (step is not None and step not in files):
        got = f"steps {sorted(files)}" if files else "none"
        raise FileNotFoundError(
            f"{folder / pattern.replace('*', '<step>' if step is None else str(step))}: no such file; expected {what}, got "
            f"{got}; give the folder of the run"
        )
    return files[max(files) if step is None else step]


def _kind(value: object) -> str:
    return f"{len(value)} values" if isinstance(value, tuple | list | dict) else type(value).__name__
