"""Runs the compression of Sec. 3.3 on "far", a device of torch whose numbers lie in CPU tensors that nothing else may touch.

As on a GPU, an operation that mixes it with the CPU is an error, and so is `.numpy()`.
"""

import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from small_room import FIELD, PAPER, make_room
from torch.utils._pytree import tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from kfgs import FeatureFolder, fit, load_scene
from kfgs.quant import GrownCodebook

COPIES = []  # shapes of what went from far to the CPU
PLAIN = torch.tensor


class Far(torch.Tensor):
    """A tensor on far."""

    @staticmethod
    def __new__(cls, near):
        size, strides = near.size(), near.stride()
        return torch.Tensor._make_wrapper_subclass(cls, size, strides=strides, dtype=near.dtype, device="far:0")

    def __init__(self, near):
        self.near = near

    def tolist(self):  # which torch refuses for subclasses
        COPIES.append(tuple(self.shape))
        return self.near.tolist()

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return compute(function, args, kwargs or {})


def compute(function, args, kwargs):
    """Run an operation of tensors on far: with their numbers, if no tensor of the CPU is among them."""
    name = function.overloadpacket.__name__
    to_cpu = str(kwargs.get("device", "far")) == "cpu" or name == "_local_scalar_dense"
    if to_cpu or (name == "copy_" and not isinstance(args[0], Far)):
        COPIES.append(tuple(args[0].shape))

    def near(value):
        if isinstance(value, torch.device):
            return torch.device("cpu")
        if isinstance(value, torch.Tensor) and not isinstance(value, Far) and value.dim():
            assert name in ("_to_copy", "copy_"), f"{name}: got a tensor on the CPU among those on far"
        return value.near if isinstance(value, Far) else value

    result = function(*tree_map(near, args), **tree_map(near, kwargs))
    if result is None or (name.endswith("_") and not name.endswith("__")):  # in place
        return None if result is None else args[0]
    return tree_map(lambda value: Far(value) if isinstance(value, torch.Tensor) and not to_cpu else value, result)


def main(folder):
    room = make_room(folder / "scene")
    scene = load_scene(room)
    maps = FeatureFolder(room / "features").of(scene, "train")  # of 30 x 40 x 32
    short = {"training": replace(FIELD, steps=2), "autoencoder": replace(PAPER.autoencoder, steps=20, blends=6)}
    for codebook in (PAPER.codebook, replace(PAPER.codebook, joins_per_image=2), GrownCodebook(maximum=12)):
        fields = []
        for device in ("cpu", "far"):  # of the compression; the field has that of kfgs.pipeline.train
            sys.modules["kfgs.pipeline.fit"].training_device = lambda device=device: torch.device(device)
            fields.append(fit(scene, maps, replace(PAPER, codebook=codebook, **short)))
        assert torch.equal(fields[0].latents, fields[1].latents)
        K = fields[0].decoder.codebook.size
        assert {(K,), (K, 32), (30, 40), (32, 24)} <= set(
            COPIES
        )  # usage, codewords, an index map, the decoder's weights
        assert max(map(math.prod, COPIES)) == 30 * 40  # no features, no similarities
        COPIES.clear()


if __name__ == "__main__":
    _setup_privateuseone_for_python_backend("far")
    library = torch.library.Library("_", "IMPL")
    library.fallback(lambda function, *args, **kw: compute(function, args, kw), "PrivateUse1")
    torch.tensor = lambda data, *, device=None, **kw: PLAIN(data, **kw).to(
        device or "cpu"
    )  # else an internal error of torch
    with tempfile.TemporaryDirectory() as temporary:
        main(Path(temporary))
