"""Where a benchmark runs: the option `--device`, times that wait for the GPU, and maps that are moved when they are read."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kfgs.quant.maps import FeatureMaps

CPU = torch.device("cpu")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option `--device`; its value is a `torch.device`, and a GPU that is named becomes torch's current one."""
    parser.add_argument("--device", type=_device, default="cpu", help="cpu (the default), cuda or cuda:1")


def _device(name: str) -> torch.device:
    if name == "cpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""  # kfgs would train on a GPU that it sees
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    if device.type == "cuda" and (device.index or 0) < torch.cuda.device_count():
        torch.cuda.set_device(device.index or 0)
    elif device.type != "cpu":
        raise argparse.ArgumentTypeError(
            f"expected cpu or a GPU, of which torch sees {torch.cuda.device_count()}; got {name}"
        )
    return device


def device_name(device: torch.device) -> str:
    """For a table: the device, and a GPU's model."""
    return f"{device}, {torch.cuda.get_device_name(device)}" if device.type == "cuda" else str(device)


def wait() -> None:
    """Wait until the current GPU has finished, if one is used. Call it before the clock is read."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def clock(call: Callable[[], Any]) -> float:
    """Seconds of one call, until the GPU has finished; its result is freed within that time."""
    wait()
    start = time.perf_counter()
    call()
    wait()
    return time.perf_counter() - start


class MapsOn:
    """Feature maps that are moved to a device when they are read."""

    def __init__(self, maps: FeatureMaps, device: torch.device) -> None:
        self._maps, self._device = maps, device
        if hasattr(maps, "grid"):  # samples of a map, without reading all of it
            self.grid = lambda i, samples: maps.grid(i, samples).to(device)

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, i: int) -> Tensor:  # [h, w, D]
        return self._maps[i].to(self._device)
