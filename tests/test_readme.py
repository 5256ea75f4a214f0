"""The Python of the README and of the guide runs as it is written, on a small room; only the schedule is shortened."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases_color import make_field, make_splat
from cases_teach import save_checkpoint
from lseg_layout import TINY

import kfgs
from kfgs import FeatureFolder, SemanticField, Uplift, fit, load_label_set, load_scene, read_splats, write_splats
from kfgs.fields import UpliftConfig, fuse_views
from kfgs.fields.store import scene_classes

SHORT = UpliftConfig.field(max_gaussians=2_000)
ROOT = Path(kfgs.__file__).parents[1]
README, GUIDE = ROOT / "README.md", ROOT / "docs" / "guide.md"


def python_of(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def examples():
    if not README.is_file():
        pytest.skip("kfgs is installed without its repository: no README.md beside it")
    return python_of(GUIDE)


@pytest.fixture(scope="module")
def desk(room, tmp_path_factory):
    """A folder as the README's user has it: scene/, features/, my.spz."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "scene").symlink_to(room)
    (folder / "features").symlink_to(room / "features")
    make_splat(room, folder / "my.spz")
    return folder


def test_examples_run_one_after_the_other(examples, desk, monkeypatch):
    monkeypatch.chdir(desk)
    _, fitting, editing, looking = examples
    assert fitting.count('Uplift("my.spz")') == 1
    known = {"SHORT": SHORT}
    exec(fitting.replace('Uplift("my.spz")', 'Uplift("my.spz", SHORT)'), known)
    assert known["chair"].mask.shape == (len(known["field"]),)
    assert len(known["labelled"].labels) == len(read_splats("my.spz"))
    make_field(Path("scene"), Path("run/field.kfgs"))  # a few small maps know no plant: this one knows the truth
    made, scene = SemanticField.load("run/field.kfgs"), load_scene("scene")
    made = replace(made, info=made.info | {"scene": "scene"}, classes=scene_classes(Path("scene")))
    fuse_views(made, [scene.cameras[i] for i in scene.views("train")]).save("run/field.kfgs")
    exec(editing, known)
    before, after = known["attached"].gaussians, read_splats("edited.ply")
    chairs = before.labels == before.names.index("chair")
    assert 0 < int(chairs.sum()) == len(before) - len(after)
    assert len(kfgs.EditList.load("edits.json")) == 1
    pytest.importorskip("anywidget")
    exec(looking, known)
    view = known["view"]
    assert view.state.selected("semantic").any()
    assert view.widget.wire["words"] == "chair"
    assert Path("room.html").stat().st_size > 100_000
    view.close()


def test_the_example_of_a_teacher_runs_with_a_tiny_lseg(examples, room, tmp_path, monkeypatch):
    shutil.copytree(room, tmp_path / "scene", ignore=shutil.ignore_patterns("features"))
    monkeypatch.chdir(tmp_path)
    save_checkpoint(Path("demo_e200.ckpt"))
    teaching = examples[0]
    assert teaching.count("fast=True") == 1
    known = {"TINY": TINY}
    exec(teaching.replace("fast=True", "fast=True, config=TINY"), known)
    maps = sorted(Path("features").glob("*.npy"))
    assert len(maps) == len(known["scene"].splits["train"])
    assert np.load(maps[0]).shape[2] == 16
    words = load_label_set("scene/text.safetensors")
    assert words.names == ("wall", "floor", "chair")
    assert words.info["teacher"]["name"] == "lseg"


def test_the_ten_lines_of_the_readme_run(examples, desk, tmp_path, monkeypatch):
    """After the four commands, which leave poses, photos, a table of words, a field and a colour splat, and no maps."""
    [code] = python_of(README)
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    scene, run = tmp_path / "scene", tmp_path / "run"
    scene.mkdir()
    room = load_scene(desk / "scene")
    load_label_set(desk / "scene" / "classes.json", desk / "scene" / "text.npy").save(scene / "text.safetensors")
    for part in ("images", "sparse", "split.json"):
        (scene / part).symlink_to(desk / "scene" / part)
    maps = FeatureFolder(desk / "features").of(room, "train")
    fit(load_scene(scene), maps, Uplift(desk / "my.spz", SHORT), folder=run)
    write_splats(read_splats(desk / "my.spz"), run / "color.ply")  # `kfgs fit` trains it where there is no splat
    monkeypatch.chdir(tmp_path)
    known = {}
    exec(code, known)
    assert known["labels"].shape == room.cameras[0].size
    assert 0 < len(known["parts"]) <= len(known["chair"])
    before, after = known["splat"], read_splats("edited.ply")
    chairs = before.labels == before.names.index("chair")
    assert 0 < int(chairs.sum()) == len(before) - len(after)
