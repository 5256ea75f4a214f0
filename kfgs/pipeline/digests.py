"""What decides the content of a stage, as digests; and a random generator for each."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from ..cameras import Camera
from ..cameras.camera import NEAR
from ..scenes import Scene


def stage_generator(seed: int, purpose: str) -> torch.Generator:
    """A generator of its own for each stage, so that skipping a finished stage changes nothing downstream."""
    digest = hashlib.sha256(f"{purpose}:{seed}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "little"))


def digest_tensors(*tensors: Tensor) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def digest_scene(scene: Scene, views: Sequence[int]) -> str:
    """SHA-256 of some views' poses, intrinsics, sizes and near planes, and of the sparse points.

    Where all near planes are at 0.2 they are left out: runs from before cameras had one stay valid.
    """
    cameras = [scene.cameras[i] for i in views]
    poses = torch.stack([camera.viewmat for camera in cameras])
    intrinsics = torch.stack([camera.K for camera in cameras])
    sizes = torch.tensor([camera.size for camera in cameras])
    near = torch.tensor([camera.near for camera in cameras], dtype=torch.float64)
    return digest_tensors(poses, intrinsics, sizes, scene.points, *([near] if (near != NEAR).any() else []))


def describe_lens(lens: Camera) -> list[Any]:
    """What decides how a lens is removed, as plain values."""
    return [lens.K.tolist(), lens.size, asdict(lens.distortion) if lens.distortion else None]
