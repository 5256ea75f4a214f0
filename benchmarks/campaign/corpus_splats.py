"""Splat files of every format, with labels in them or beside them, and point clouds."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import torch

from kfgs.formats import write_splats
from kfgs.formats.ply import write_ply
from kfgs.formats.table import formats
from kfgs.gaussians import Gaussians

from .corpus import SEED, Add


def cloud(n: int = 12, degree: int = 1, labels: bool = True) -> Gaussians:
    """Random Gaussians of three classes."""
    g = torch.Generator().manual_seed(SEED)
    gaussians = Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.rand(n, 3, generator=g) + 0.1,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g) * 0.3,
        labels=torch.arange(n) % 3 if labels else None,
    )
    return gaussians.replace(names=("wall", "chair", "plant") if labels else ())


def make(folder: Path, add: Add) -> None:
    """One folder per format, and what other programs write."""
    for name, module in formats().items():
        if not hasattr(module, "write"):
            continue
        place = folder / name
        place.mkdir(parents=True)
        path = place / f"a{module.SUFFIXES[0]}"
        for file in write_splats(cloud(), path).paths[0 if "labels" in module.HOLDS else 1 :]:
            add("splats", place, file.name, opens=path.name)
        if "labels" not in module.HOLDS:  # their digest would refuse every mutant
            alone = folder / f"{name}-alone"
            alone.mkdir()
            write_splats(cloud(labels=False), alone / path.name)
            add("splats", alone, path.name)
    _others(folder / "others", add)


def _others(place: Path, add: Add) -> None:
    place.mkdir()
    write_splats(cloud(labels=False), place / "a.gltf")
    (place / "two.spz").write_bytes(_spz_2())
    (place / "a.ksplat").write_bytes(_ksplat())
    (place / "ascii.ply").write_bytes(_ascii_ply())
    add("splats", place, "a.gltf", "two.spz", "a.ksplat", "ascii.ply")
    write_ply(place / "points.ply", {name: np.arange(9, dtype=np.float32) for name in "xyz"})
    add("cloud", place, "points.ply")


def _ascii_ply() -> bytes:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    head = "".join(f"property float {name}\n" for name in names)
    rows = "\n".join(" ".join(f"{i + j / 8:g}" for j in range(len(names))) for i in range(6))
    return f"ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 6\n{head}end_header\n{rows}\n".encode()


def _ksplat(n: int = 3) -> bytes:
    """Level 1: one section, buckets of one Gaussian, without spherical harmonics."""
    head = struct.pack("<BB2xIIIIH14xff", 0, 1, 1, 1, n, n, 1, -1.5, 1.5).ljust(4096, b"\0")
    head += struct.pack("<IIIIfH2xI4xIIH", n, n, 1, n, 5.0, 12, 32767, n, 0, 0).ljust(1024, b"\0")
    centres = b"".join(struct.pack("<3f", i, -i, 2 * i) for i in range(n))
    row = struct.pack("<3H7e4B", 32000, 33000, 32767, 0.5, 0.25, 1, 1, 0, 0, 0, 200, 100, 50, 255)
    return head + centres + row * n


def _spz_2() -> bytes:
    """SPZ of version 2, in gzip: six Gaussians of 19 bytes."""
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 6, 0, 12, 0, 0) + bytes(range(6 * 19)))
