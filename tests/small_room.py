"""A toy room small enough to fit in seconds, shared by the tests of pipeline and command line."""

import dataclasses
import shutil
from pathlib import Path

from cases_color import make_field, make_splat
from cases_training import changed

from kfgs import FeatureFolder, Paper, Uplift, attach, fit, load_scene, write_splats
from kfgs.fields import Training, UpliftConfig
from kfgs.quant import AutoencoderConfig, PaperCodebook
from kfgs.toy.room_folder import ToyConfig, make_toy_room

ROOM = ToyConfig(
    train_views=6,
    test_views=3,
    size=(60, 80),
    feature_size=(30, 40),
    feature_dim=32,
    surface_points=4_000,
    sparse_points=1_500,
)
FIELD = changed(
    Training.cpu(), steps=120, features_rate=0.05, start=20, stop=80, every=20, reset_every=0, checkpoint_every=7
)
PAPER = Paper.paper(
    codebook=PaperCodebook(initial=4, maximum=24, epochs=4, step_every=1, learning_rate=0.02),
    autoencoder=AutoencoderConfig.paper(latent=4, encoder=(24, 16), decoder=(16, 24), steps=400, learning_rate=3e-3),
    training=FIELD,
)

SMALL = UpliftConfig.field(max_gaussians=1_500)


def make_room(folder: Path) -> Path:
    return make_toy_room(folder, ROOM)


def make_desk(folder: Path) -> Path:
    """What a user has: scene/, run/ (`kfgs fit`, and color.ply), my.ply of another program, labelled.ply (`kfgs attach`).

    And true/field.kfgs, a field without classes of its own whose features are those of the true classes.
    """
    splat = make_splat(make_room(folder / "scene"), folder / "my.ply")
    scene = load_scene(folder / "scene")
    maps = FeatureFolder(folder / "scene" / "features", [scene.stem(i) for i in scene.views("train")])
    field = fit(scene, maps, Uplift(splat, UpliftConfig.field(max_gaussians=2_000)), folder=folder / "run")
    write_splats(attach(field, splat).gaussians, folder / "labelled.ply")
    shutil.copyfile(splat, folder / "run" / "color.ply")
    make_field(folder / "scene", folder / "true" / "field.kfgs")
    return folder


def paper(**changes):
    return dataclasses.replace(PAPER, **changes)


def stages(lines: list[str]) -> dict[str, str]:
    """The stages that a fit reported, and whether each was "found" or "done"."""
    words = ((line.partition(": ")[0], line.partition(": ")[2]) for line in lines)
    return {name: rest.split()[0] for name, rest in words if rest.startswith(("found in", "done in"))}
