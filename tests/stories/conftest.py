"""The room of the stories, and what is fitted to it once. Only public names; numbers were recorded on `v0-everything`."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import kfgs
from kfgs.fields import Densify
from kfgs.quant import AutoencoderConfig, PaperCodebook

ROOM = kfgs.ToyConfig(
    train_views=16, test_views=4, size=(120, 160), feature_size=(60, 80), feature_dim=64, sparse_points=6_000
)
CODEBOOK = PaperCodebook(epochs=6, step_every=2, learning_rate=0.02, expand_below=0.8, joins_per_image=1)
AUTOENCODER = AutoencoderConfig.paper(latent=8, encoder=(48, 32), decoder=(32, 48), steps=1_500, learning_rate=3e-3)
TRAINING = replace(
    kfgs.Training.cpu(),
    steps=400,
    rates=replace(kfgs.Training.cpu().rates, features=0.03),
    densify=Densify(50, 250, 50, 8e-4, reset_every=0, maximum=8_000),
)


@pytest.fixture(scope="session")
def recorded() -> dict[str, float]:
    return json.loads(Path(__file__).with_name("recorded.json").read_text())


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> SimpleNamespace:
    """A toy room on disk, and its scene, classes, and the teacher's maps."""
    folder = kfgs.make_toy_room(tmp_path_factory.mktemp("stories") / "room", ROOM)
    scene = kfgs.load_scene(folder)
    classes = kfgs.load_label_set(folder / "classes.json", folder / "text.npy")
    maps = kfgs.FeatureFolder(folder / "features").of(scene, "train")
    unseen = [scene.cameras[i] for i in scene.views("test")]
    return SimpleNamespace(folder=folder, scene=scene, classes=classes, maps=maps, unseen=unseen, out=folder.parent)


@pytest.fixture(scope="session")
def codebook_options():
    return CODEBOOK


@pytest.fixture(scope="session")
def color(room) -> kfgs.Gaussians:
    """A colour field of the room: a short training."""
    quick = kfgs.ColorConfig.quick()
    short = quick.training.with_steps(400).with_maximum(12_000)
    return kfgs.fit_color(room.scene, room.out / "color", replace(quick, training=short))


@pytest.fixture(scope="session")
def fused(room, color) -> kfgs.SemanticField:
    """The room's field by kfgs's method: features averaged onto the colour field's Gaussians."""
    return kfgs.fit(room.scene, room.maps, kfgs.Uplift(color), folder=room.out / "fused")


@pytest.fixture(scope="session")
def paper(room) -> kfgs.SemanticField:
    """The room's field by the paper's method: codebook, autoencoder, and Gaussians trained on latent maps."""
    method = kfgs.Paper.paper(codebook=CODEBOOK, autoencoder=AUTOENCODER, training=TRAINING)
    return kfgs.fit(room.scene, room.maps, method, folder=room.out / "paper")
