"""Arguments that are to be objects of kfgs are checked when a public function is called; numbers by `check_range`."""

from pathlib import Path

import numpy as np
import pytest
import torch
from kfgs.pipeline.fuse import uplift
from messages import tells

from kfgs import Gaussians
from kfgs._check import check_range
from kfgs._typed import typed
from kfgs.cameras import Camera
from kfgs.fields import Identity, SemanticField
from kfgs.formats import write_splats
from kfgs.labels import transfer_labels
from kfgs.labels.scores import select_by_similarity
from kfgs.pipeline import FitConfig, attach, fit_scene
from kfgs.pipeline.color import ColorConfig, fit_color
from kfgs.scenes import Scene

SCENE = Scene([], [], torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
CLOUD = Gaussians(torch.eye(3), torch.ones(3, 4), torch.ones(3, 3), torch.full((3,), 0.5), features=torch.eye(3))
FIELD = SemanticField(CLOUD, Identity(3))


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda: fit_scene("S", [], "R"), ("scene", "Scene", "str", "load_scene")),
        (lambda: fit_scene(SCENE, [], "R", {"seed": 1}), ("config", "FitConfig or None", "dict", "FitConfig(...)")),
        (lambda: fit_scene(SCENE, [], "R", report="x"), ("report", "function", "str", "print")),
        (lambda: fit_scene(SCENE, [], "R", splat=5), ("splat", "path", "int", "read_splats")),
        (lambda: fit_color("S", "R"), ("scene", "Scene", "str", "load_scene")),
        (lambda: uplift("S", [], CLOUD), ("scene", "Scene", "str")),
        (lambda: attach("R/field", "L.ply"), ("field", "SemanticField", "str", "SemanticField.load(path)")),
        (lambda: attach(FIELD, "L.ply", "words"), ("classes", "LabelSet or None", "str", "load_label_set")),
        (lambda: FIELD.segment("view_1"), ("camera", "Camera", "str", ".cameras")),
        (lambda: write_splats({"means": 1}, "a.ply"), ("splats", "SplatFile", "dict", "read_splats")),
    ],
)
def test_a_path_or_dict_instead_of_an_object_is_named(call, parts):
    with pytest.raises(TypeError, match=tells(*parts)):
        call()


def test_what_is_not_of_kfgs_is_left_to_the_function():
    @typed
    def probe(cloud: Gaussians, place: str | Path, rows: list[int], config: FitConfig | None = None) -> str:
        """Return a word."""
        return "done"

    assert probe(CLOUD, 5, ["no number"]) == "done"
    assert probe.__name__ == "probe"
    with pytest.raises(TypeError, match="missing a required argument: 'place'"):
        probe(CLOUD)


@pytest.mark.parametrize("wrong", [True, np.True_, torch.tensor(True), "0.5", None, 1j])
def test_only_numbers_are_numbers(wrong):
    with pytest.raises(TypeError, match=tells("threshold: expected a number", "pass a float")):
        check_range("threshold", wrong, 0, 1)


@pytest.mark.parametrize("right", [1, 0.5, np.float32(0.5), torch.tensor(0.5), torch.tensor([1])])
def test_numbers_of_every_library_are_numbers(right):
    check_range("threshold", right, 0, 1)


def test_truth_values_and_texts_are_no_thresholds_and_distances():
    for wrong in (True, "0.5"):
        with pytest.raises(TypeError, match=tells("threshold: expected a number", repr(wrong))):
            select_by_similarity(torch.rand(5), threshold=wrong)
        with pytest.raises(TypeError, match=tells("distance: expected a number", repr(wrong))):
            transfer_labels(torch.eye(3), torch.zeros(3, dtype=torch.long), torch.eye(3), wrong)


@pytest.mark.parametrize("config", [FitConfig, ColorConfig])
def test_a_seed_is_a_whole_number(config):
    assert config(seed=-3).seed == -3
    for wrong in ("0", 1.5, True):
        with pytest.raises((TypeError, ValueError), match=tells("seed: expected", repr(wrong))):
            config(seed=wrong)


def test_views_of_a_split_are_whole_numbers():
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), name="a.png")
    parts = ([camera], [Path("a.png")], torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    assert Scene(*parts, splits={"train": [np.int64(0)]}).views("train") == [0]
    for wrong in (0.0, "0"):
        with pytest.raises(ValueError, match=tells("splits['train']", "whole numbers", repr(wrong))):
            Scene(*parts, splits={"train": [wrong]})


def test_a_camera_of_more_pixels_than_can_be_numbered():
    with pytest.raises(ValueError, match=tells("width, height", "100,000 x 100,000", "give a smaller size")):
        Camera.look_at((0, -4, 0), (0, 0, 0), width=100_000, height=100_000)
