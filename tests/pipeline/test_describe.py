"""What `kfgs convert` says of folders that are no scene."""

import shutil

import numpy as np
import torch
from messages import refused
from PIL import Image

from kfgs.pipeline.describe import describe
from kfgs.scenes import SceneError


def test_a_scene_that_cannot_be_read_says_why(room, tmp_path):
    shutil.copytree(room / "images", tmp_path / "images")
    shutil.copytree(room / "sparse", tmp_path / "sparse")
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(b"junk")
    refused(lambda: describe(tmp_path), "cameras.bin", error=SceneError)


def test_maps_with_a_picture_among_them_are_maps(tmp_path):
    Image.new("RGB", (9, 6)).save(tmp_path / "preview.png")
    np.save(tmp_path / "a.npy", torch.ones(6, 9, 8).numpy())
    assert "1 feature maps by another program" in describe(tmp_path)


def test_a_folder_with_nothing_that_is_known(tmp_path):
    refused(lambda: describe(tmp_path), "expected a COLMAP model", error=SceneError)
