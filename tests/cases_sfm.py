"""Small photographs for structure from motion."""

from pathlib import Path

import torch
from kornia.geometry import resize
from kornia.io import write_image

from kfgs.scenes import read_image

WIDTH = 320


def downsized(source: Path, target: Path, count: int) -> Path:
    target.mkdir()
    for file in sorted(source.iterdir())[:count]:
        image = read_image(file).permute(2, 0, 1)[None]
        height = round(image.shape[2] * WIDTH / image.shape[3])
        small = resize(image, (height, WIDTH), antialias=True)[0].clamp(0, 1)
        write_image(str(target / f"{file.stem}.png"), (small * 255).round().to(torch.uint8))
    return target
