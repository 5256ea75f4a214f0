"""The small room as a scene with its maps and classes, and the fields of both methods, made once."""

import pytest
from cases_color import surface
from small_room import PAPER, SMALL

from kfgs import FeatureFolder, Uplift, fit, load_label_set, load_scene


@pytest.fixture(scope="session")
def scene(room):
    return load_scene(room)


@pytest.fixture(scope="session")
def maps(room, scene):
    return FeatureFolder(room / "features").of(scene, "train")


@pytest.fixture(scope="session")
def classes(room):
    return load_label_set(room / "classes.json", room / "text.npy")


@pytest.fixture(scope="session")
def splat(room):
    """A Gaussian on each of 4,000 points of the true surface, small and opaque."""
    return surface(room)[0]


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    """The folder of the runs of the next two, which no test changes."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="session")
def trained(scene, maps, runs):
    return fit(scene, maps, PAPER, folder=runs / "paper")


@pytest.fixture(scope="session")
def fused(scene, maps, splat, runs):
    return fit(scene, maps, Uplift(splat, SMALL), folder=runs / "fused")
