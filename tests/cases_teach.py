"""LSeg made tiny as a teacher of a user's own, which logs its pictures; and real photographs of a door made small."""

import os
import time
from pathlib import Path

import torch
from lseg_layout import random_state
from PIL import Image

from kfgs.teachers.lseg import LSegConfig, load_lseg

TINY = LSegConfig(
    width=32, depth=4, heads=4, window=64, position_grid=3, hooks=(0, 1, 2, 3), neck=(8, 12, 16, 20), fusion=12, dim=16,
    text_width=32, text_layers=2, text_heads=4,
)  # fmt: skip
SCALE = 8  # by which the door's photographs, 1296 x 1936, are made smaller


class TinyLSeg:
    """LSeg's own code with a tiny network, one window per picture; `package.module:TinyLSeg` on the command line.

    In a command started with TEACH_LOG each picture adds a line to that file; at line TEACH_STOP it waits to be ended.
    """

    name = "lseg"

    def __init__(self, weights):
        self.lseg = load_lseg(weights, config=TINY, fast=True)

    @property
    def identity(self):
        return self.lseg.identity

    def encode_image(self, image):
        if "TEACH_LOG" in os.environ:
            with Path(os.environ["TEACH_LOG"]).open("a") as log:
                log.write(f"{image.sum():.3f}\n")
            if Path(os.environ["TEACH_LOG"]).read_text().count("\n") == int(os.environ.get("TEACH_STOP", "0")):
                time.sleep(3600)
        return self.lseg.encode_image(image)

    def encode_text(self, prompts):
        return self.lseg.encode_text(prompts)


def save_checkpoint(path: Path, seed: int = 0) -> Path:
    """A checkpoint as LSeg's authors wrote theirs, of the tiny network and random weights."""
    state = random_state(TINY, torch.Generator().manual_seed(seed))
    torch.save({"epoch": 200, "state_dict": state, "hyper_parameters": {"backbone": "clip_vitl16_384"}}, path)
    return path


def shrink_door(source: Path, folder: Path) -> Path:
    """The 12 photographs and their COLMAP model with pixels 8 times as large; the cameras keep their lens.

    Of the points a fifth stays: to read them all takes half a second, in every command.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    for path in sorted((source / "images").iterdir()):
        with Image.open(path) as photo:
            small = photo.resize((photo.width // SCALE, photo.height // SCALE), Image.Resampling.BOX)
        small.save(folder / "images" / path.name, quality=95)
    model = source / "colmap_ground_truth"
    _rewrite(model / "cameras.txt", folder / "sparse/0/cameras.txt", _shrink_camera, lambda line: "")
    _rewrite(model / "images.txt", folder / "sparse/0/images.txt", lambda line: line, _shrink_points)
    lines = (model / "points3D.txt").read_text().splitlines(keepends=True)
    (folder / "sparse/0/points3D.txt").write_text("".join(line for line in lines if line[0] == "#" or _kept(line)))
    return folder


def _rewrite(source, target, first, second):
    """Each line of a COLMAP text file by turns through two functions; comments stay."""
    lines = source.read_text().splitlines()
    data = [line for line in lines if not line.startswith("#")]
    kept = [line for line in lines if line.startswith("#")]
    kept += [(first, second)[i % 2](line) for i, line in enumerate(data)]
    target.write_text("\n".join(kept) + "\n")


def _shrink_camera(line):
    number, model, width, height, f, cx, cy, k = line.split()
    sides = [str(int(side) // SCALE) for side in (width, height)]
    return " ".join([number, model, *sides, *(str(float(value) / SCALE) for value in (f, cx, cy)), k])


def _shrink_points(line):
    words = line.split()
    for i in range(0, len(words), 3):
        words[i : i + 2] = [str(float(value) / SCALE) for value in words[i : i + 2]]
        if not _kept(words[i + 2]):
            words[i + 2] = "-1"  # COLMAP's for a pixel that shows no point
    return " ".join(words)


def _kept(line):
    """Whether a point stays, by the number that its line begins with."""
    return int(line.split()[0]) % 5 == 0
