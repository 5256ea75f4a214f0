"""Feature maps as kfgs and other programs write them, and checkpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file

from kfgs.cameras import Camera
from kfgs.scenes import Scene, extract_features

from .corpus import SEED, Add

MAP = np.random.default_rng(SEED).standard_normal((3, 4, 5)).astype(np.float16)


def make(folder: Path, add: Add) -> None:
    """Folders of maps, and checkpoints."""
    place = folder / "others"
    place.mkdir(parents=True)
    np.save(place / "a.npy", MAP)
    add("maps", place, "a.npy", opens=".")
    place = folder / "feature3dgs"
    place.mkdir()
    torch.save(torch.from_numpy(MAP).permute(2, 0, 1).contiguous(), place / "a_fmap_CxHxW.pt")
    add("maps", place, "a_fmap_CxHxW.pt", opens=".")
    place = folder / "safetensors"
    place.mkdir()
    save_file({"map": torch.from_numpy(MAP)}, place / "a.safetensors")
    add("maps", place, "a.safetensors", opens=".")
    _written(folder / "written", add)
    _checkpoints(folder / "checkpoints", add)


def _grey(picture: torch.Tensor) -> torch.Tensor:
    """A teacher: colours and their products."""
    small = picture[:, ::4, ::4]
    return torch.cat([small, small.square() + 0.1])


def _written(place: Path, add: Add) -> None:
    pictures = place.with_name("pictures")
    pictures.mkdir()
    for name in ("a", "b"):
        Image.fromarray((np.arange(12 * 16 * 3).reshape(12, 16, 3) % 256).astype(np.uint8)).save(
            pictures / f"{name}.png"
        )
    paths = sorted(pictures.iterdir())
    cameras = [Camera(torch.eye(4), torch.eye(3), 16, 12, path.name) for path in paths]
    extract_features(_grey, Scene(cameras, paths, torch.zeros(0, 3), torch.zeros(0, 3)), place, "all")
    add("maps", place, "features.json", opens=".")
    add("manifest", place, "features.json", opens=".")


def _checkpoints(place: Path, add: Add) -> None:
    place.mkdir()
    state = {"conv.weight": torch.ones(4, 3), "conv.bias": torch.zeros(4, dtype=torch.float16), "step": torch.tensor(3)}
    torch.save(state, place / "state.pt")
    torch.save({"state_dict": state, "epoch": 3, "hyper": {"lr": 0.1, "names": ["a", "b"]}}, place / "lightning.ckpt")
    torch.save(state, place / "legacy.pth", _use_new_zipfile_serialization=False)
    save_file(state, place / "state.safetensors")
    add("checkpoint", place, "state.pt", "lightning.ckpt", "legacy.pth", "state.safetensors")
