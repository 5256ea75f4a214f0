"""What `kfgs convert` says of folders that are no scene."""

import shutil

import numpy as np
import pytest
import torch
from messages import tells
from small_room import make_room

from kfgs.pipeline.describe import describe
from kfgs.scenes import SceneError


@pytest.fixture
def captures(tmp_path):
    """Two scenes, a capture that lost its poses, and photos alone."""
    folder = tmp_path / "captures"
    make_room(folder / "flat2")
    shutil.copytree(folder / "flat2", folder / "flat10")
    shutil.copytree(folder / "flat2", folder / "lost", ignore=shutil.ignore_patterns("sparse"))
    shutil.copytree(folder / "flat2" / "images", folder / "photos")
    return folder


def test_a_scene_that_cannot_be_read_says_why(captures):
    (captures / "flat2" / "sparse" / "0" / "cameras.bin").write_bytes(b"junk")
    with pytest.raises(SceneError, match=tells("cameras.bin")):
        describe(captures / "flat2")


def test_maps_with_a_picture_among_them_are_maps(captures, tmp_path):
    shutil.copy(next((captures / "photos").iterdir()), tmp_path / "preview.png")
    np.save(tmp_path / "a.npy", torch.ones(6, 9, 8).numpy())
    shutil.rmtree(captures)
    assert "1 feature maps by another program" in describe(tmp_path)


def test_a_folder_with_nothing_that_is_known(tmp_path):
    with pytest.raises(SceneError, match=tells("expected a COLMAP model")):
        describe(tmp_path)
