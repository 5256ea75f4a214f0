"""What public functions say when they get a path or a word instead of an object."""

import pytest
import torch
from messages import tells

from kfgs import Gaussians, attach, fit, fit_color
from kfgs.fields import Identity, SemanticField
from kfgs.scenes import Scene

SCENE = Scene([], [], torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
CLOUD = Gaussians(torch.eye(3), torch.ones(3, 4), torch.ones(3, 3), torch.full((3,), 0.5), features=torch.eye(3))
FIELD = SemanticField(CLOUD, Identity(3))


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda: fit("S", []), ("scene", "Scene", "str", "load_scene")),
        (lambda: fit(SCENE, [], "paper"), ("method", "Paper()", "str")),
        (lambda: fit(SCENE, [], progress="x"), ("progress", "'x'")),
        (lambda: fit_color("S", "R"), ("scene", "Scene", "str", "load_scene")),
        (lambda: attach("R/field", CLOUD), ("field", "SemanticField", "str", "SemanticField.load(path)")),
        (lambda: attach(FIELD, CLOUD, frame="x"), ("frame", "Similarity", "str")),
    ],
)
def test_a_path_instead_of_an_object_is_named(call, parts):
    with pytest.raises(TypeError, match=tells(*parts)):
        call()


@pytest.mark.parametrize("wrong", ["0", 1.5, True])
def test_a_seed_is_a_whole_number(wrong):
    with pytest.raises((TypeError, ValueError), match=tells("seed: expected", repr(wrong))):
        fit(SCENE, [], seed=wrong)
