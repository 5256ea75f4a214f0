"""What `kfgs convert` says of folders that are no scene."""

import base64
import dataclasses
import re
import shutil

import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image
from small_room import PAPER

from kfgs.pipeline import Uplift
from kfgs.pipeline.describe import describe
from kfgs.pipeline.run_report import WIDTH, write_run_report
from kfgs.scenes import SceneError


@pytest.fixture
def folder(trained, runs, tmp_path):
    return shutil.copytree(runs / "paper", tmp_path / "a <b> run")


def test_the_page_says_all_and_loads_nothing(folder, trained, scene):
    paths = write_run_report(folder, trained, scene, PAPER, command="kfgs fit 'a <b> scene'")
    assert [path.name for path in paths] == ["preview.png", "codebook.png", "field.png", "report.html"]
    page = paths[-1].read_text()
    shown = [base64.b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", page)]
    assert shown == [path.read_bytes() for path in paths[:-1]]
    text = re.sub(r"data:image[^\"]+", "", page)
    assert "kfgs fit &#x27;a &lt;b&gt; scene&#x27;" in text
    assert "<b>" not in text
    for stage in trained.info["seconds"]:
        assert f"<td>{stage}</td>" in text
    assert f"<td>{len(trained):,}</td>" in text
    assert "&quot;codebook&quot;: {" in text  # the options of the paper's method, and no others
    assert "&quot;uplift&quot;: {" not in text
    assert not re.search(r"http|<script|<link|@import|url\(", text)
    preview = np.asarray(Image.open(paths[0]))  # three views, each with photograph, features and labels
    height = round(WIDTH * scene.cameras[0].height / scene.cameras[0].width)
    assert preview.shape[1] == pytest.approx(3 * WIDTH, abs=30)
    assert 3 * height < preview.shape[0] < 3 * height + 150


def test_without_photographs_there_is_a_page_still(folder, trained, scene, tmp_path):
    gone = dataclasses.replace(scene, image_paths=[tmp_path / path.name for path in scene.image_paths])
    paths = write_run_report(folder, trained, gone, Uplift())
    assert [path.name for path in paths] == ["codebook.png", "field.png", "report.html"]
    assert "kfgs.fit(scene, maps, " in paths[-1].read_text()
    assert "&quot;uplift&quot;: {" in paths[-1].read_text()


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
