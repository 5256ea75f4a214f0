import base64
import dataclasses
import re

import numpy as np
import pytest
from PIL import Image
from small_room import PAPER, make_room

from kfgs.pipeline import Uplift, fit
from kfgs.pipeline.run_report import WIDTH, write_preview, write_run_report
from kfgs.scenes import FeatureFolder, load_scene


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    scene = load_scene(make_room(folder / "a <b> scene"))
    maps = FeatureFolder(scene.folder / "features").of(scene, "train")
    return folder / "run", scene, fit(scene, maps, PAPER, folder=folder / "run")


def test_the_page_says_all_and_loads_nothing(run):
    folder, scene, field = run
    paths = write_run_report(folder, field, scene, PAPER, command="kfgs fit 'a <b> scene'")
    assert [path.name for path in paths] == ["preview.png", "codebook.png", "field.png", "report.html"]
    page = paths[-1].read_text()
    shown = [base64.b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", page)]
    assert shown == [path.read_bytes() for path in paths[:-1]]
    text = re.sub(r"data:image[^\"]+", "", page)
    assert "kfgs fit &#x27;a &lt;b&gt; scene&#x27;" in text
    assert "<b>" not in text
    for stage in field.info["seconds"]:
        assert f"<td>{stage}</td>" in text
    assert f"<td>{len(field):,}</td>" in text
    assert "&quot;codebook&quot;: {" in text  # the options of the paper's method, and no others
    assert "&quot;uplift&quot;: {" not in text
    assert not re.search(r"http|<script|<link|@import|url\(", text)


def test_a_preview_has_a_row_for_each_view(run, tmp_path):
    _, scene, field = run
    assert write_preview(tmp_path / "a.png", field, scene, "train")
    picture = np.asarray(Image.open(tmp_path / "a.png"))
    height = round(WIDTH * scene.cameras[0].height / scene.cameras[0].width)
    assert picture.shape[1] == pytest.approx(3 * WIDTH, abs=30)
    assert 3 * height < picture.shape[0] < 3 * height + 150


def test_without_photographs_there_is_a_page_still(run, tmp_path):
    folder, scene, field = run
    gone = dataclasses.replace(scene, image_paths=[tmp_path / path.name for path in scene.image_paths])
    assert write_preview(tmp_path / "a.png", field, gone, "train") is False
    paths = write_run_report(folder, field, gone, Uplift())
    assert "kfgs.fit(scene, maps, " in paths[-1].read_text()
    assert "&quot;uplift&quot;: {" in paths[-1].read_text()
