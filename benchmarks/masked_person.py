"""Paste a person into a third of the toy room's photos, and train colours with and without masks of it.

    python benchmarks/masked_person.py OUT [--steps 1600]

Every score is of the photos without the person (`kfgs-color/1`): unseen views, and the views in which the person stood.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from kfgs.evaluation.color import score_views
from kfgs.pipeline.color import ColorConfig, fit_color
from kfgs.scenes import load_scene
from kfgs.toy.room_folder import make_toy_room


def paste(room: Path, rng: np.random.Generator) -> None:
    """Draw a striped ellipse of a third of the picture into every third training photo, and write its mask."""
    scene = load_scene(room)
    for i in scene.views("train")[::3]:
        photo = np.array(Image.open(scene.image_paths[i]).convert("RGB"))
        height, width = photo.shape[:2]
        y, x = np.mgrid[:height, :width]
        inside = ((y - 0.6 * height) / (0.4 * height)) ** 2 + (
            (x - rng.uniform(0.3, 0.7) * width) / (0.17 * width)
        ) ** 2 < 1
        photo[inside] = np.where(y[inside] // 8 % 2, 255, 20)[:, None] * np.array([1, 0.2, 0.9])
        Image.fromarray(photo).save(scene.image_paths[i])
        mask = room / "masks" / f"{scene.cameras[i].name}.png"
        mask.parent.mkdir(exist_ok=True)
        Image.fromarray(np.uint8(255) * ~inside).save(mask)


def main() -> None:
    """Train three times, and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=1_600, help="of the preset quick; fewer compress it")
    args = parser.parse_args()
    clean, crowded = make_toy_room(args.out / "clean"), args.out / "crowded"
    if not crowded.exists():
        paste(Path(shutil.copytree(clean, crowded)), np.random.default_rng(0))
    config = ColorConfig.quick()
    config = replace(config, training=config.training.with_steps(args.steps))
    truth, masked = load_scene(clean), load_scene(crowded)
    stood = replace(truth, splits={**truth.splits, "stood": truth.views("train")[::3]})
    for name, scene in (("no person", truth), ("masks", masked), ("no masks", replace(masked, masks=None))):
        found = fit_color(scene, args.out / name.replace(" ", "_"), config, report=print)
        scores = (score_views(found, stood, split).psnr.value for split in ("test", "stood"))
        print(name, *(f"{score:.2f} dB" for score in scores), flush=True)


if __name__ == "__main__":
    main()
