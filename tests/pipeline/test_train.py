"""Where a field is trained."""

import pytest
import torch
from messages import tells

from kfgs.pipeline.train import check_scene, training_device
from kfgs.scenes import Scene


def test_auto_is_the_gpu_if_there_is_one():
    assert training_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")


def test_a_named_device_is_taken():
    assert training_device("cpu") == torch.device("cpu")
    assert training_device(torch.device("cpu")) == torch.device("cpu")


@pytest.mark.parametrize("device", ["gpu", "mps", "cuda:99"])
def test_what_is_not_there_is_refused(device):
    with pytest.raises(ValueError, match=tells("device:", f"got {device!r}")):
        training_device(device)


@pytest.mark.parametrize(("count", "got"), [(0, "got 0"), (1, "got 1"), (9, "got 9 at one")])
def test_a_scene_without_different_points_is_refused_before_the_work(count, got):
    points = torch.ones(count, 3)
    with pytest.raises(ValueError, match=tells("scene:", got, "kfgs sfm")):
        check_scene(Scene([], [], points, torch.zeros(count, 3, dtype=torch.uint8)))
