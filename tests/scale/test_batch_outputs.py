"""What a batch may write to: nothing of a scene, no file of somebody else, nothing behind a link; what it takes as its own."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from colmap_models import write_model, write_picture
from messages import tells

from kfgs._notes import hear
from kfgs.cli import main
from kfgs.scale import BatchOptions, SceneEntry, run_batch, stages
from kfgs.scale.options import Job
from kfgs.scale.places import Place, open_place
from kfgs.scenes import SceneError
from tests.features.test_extract import paint

OURS = {
    "state.json": json.dumps({"format": "kfgs-batch/1", "failure": {"stage": "fit", "message": "no space"}}),
    "log.txt": "2026-11-23 10:00:00 scene: done in 1.0 s\n",
    "scores.json": json.dumps({"command": "kfgs batch"}),
    "done/sfm.json": json.dumps({"key": None}),
    "done/fit.json": json.dumps({"key": "0123", "result": {}, "files": {}}),
}


class Killed(BaseException):
    """Ends a task like a kill."""


class Idle:
    """An engine to which nothing may be submitted."""

    def submit(self, *_):
        raise AssertionError("work began")


def batch(scenes, out, **options):
    return run_batch(scenes, out, client=Idle(), **options)


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "captures" / "kitchen").mkdir(parents=True)
    return tmp_path / "captures" / "kitchen"


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("text", ["", "my notes\n", '{"format": "mine", "command": "mine"}', "[1]"])
@pytest.mark.parametrize("kind", ["folder", "memory"])
def test_a_file_of_somebody_else_is_not_replaced(scene, tmp_path, name, text, kind):
    out = str(tmp_path / "runs") if kind == "folder" else f"memory://{tmp_path.name}"
    with open_place(f"{out}/kitchen") as place:
        for one in (*OURS, name):
            place.write_text(one, OURS[one] if one != name else text)
        with pytest.raises(FileExistsError, match=tells(f"{out}/kitchen/{name}", "kfgs batch", "move it away")):
            batch([scene], out)
        assert place.read_text(name) == text
        place.write_text(name, OURS[name])
        assert batch([scene], out)[0].failure.message == "no space"  # all are of a batch


def test_bytes_that_are_no_text_are_not_replaced(scene, tmp_path):
    (tmp_path / "runs" / "kitchen").mkdir(parents=True)
    (tmp_path / "runs" / "kitchen" / "log.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(FileExistsError, match=tells("log.txt", "move it away")):
        batch([scene], tmp_path / "runs")


@pytest.mark.parametrize(
    "name", ["", "done", "features", "scene", "scene/sparse/0", "segmented", "state.json", "log.txt"]
)
def test_links_in_the_output_are_not_followed(scene, tmp_path, name):
    link, elsewhere = tmp_path / "runs" / "kitchen" / name, tmp_path / "elsewhere"
    elsewhere.mkdir()
    target = elsewhere / name if name in OURS else elsewhere
    if name in OURS:
        target.write_text(OURS[name])
    before = sorted(elsewhere.iterdir())
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(target)
    with pytest.raises((ValueError, FileExistsError), match=tells(link)):
        batch([scene], tmp_path / "runs")
    assert sorted(elsewhere.iterdir()) == before


@pytest.mark.parametrize("out", ["kitchen", "kitchen/runs", ".", "link"])
def test_no_run_lies_in_a_scene(scene, tmp_path, out):
    (scene.parent / "link").symlink_to(scene)
    with pytest.raises(ValueError, match=tells("out", "apart from all scenes", "'kitchen'", scene)):
        batch([scene], scene.parent / out)
    with pytest.raises(ValueError, match=tells("out", "'hall'", scene)):  # also of another scene
        batch([SceneEntry("hall", str(tmp_path)), SceneEntry("kitchen", str(scene))], scene / "runs")
    assert list(scene.iterdir()) == []


def test_no_run_lies_in_a_scene_of_a_store():
    for out in ("s3://captures", "s3://captures/", "s3://captures/kitchen/runs"):
        with pytest.raises(ValueError, match=tells("out", "apart from all scenes", "kitchen")):
            batch(["s3://captures/kitchen/"], out)


@pytest.fixture
def photos(tmp_path, monkeypatch):
    """A folder of photos, and structure from motion that writes one file, or is killed after it."""
    for i in range(3):
        paint(tmp_path / "photos" / f"{i}.png", i)
    calls = []

    def run(images, out, *, config, replace):
        model = Path(out) / "sparse" / "0"
        assert replace or not model.exists()
        model.mkdir(parents=True, exist_ok=True)
        (model / "cameras.bin").write_text("found")
        calls.append("sfm")
        raise Killed

    monkeypatch.setattr(stages, "run_sfm", run)
    return Job(str(tmp_path / "photos"), str(tmp_path / "runs" / "photos"), BatchOptions()), calls


def test_cameras_of_somebody_else_are_not_replaced(photos):
    job, calls = photos
    own = Path(job.out) / "scene" / "sparse" / "0" / "cameras.bin"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    for _ in range(2):
        with pytest.raises(FileExistsError, match=tells("scene/sparse/0", "move it away")):
            stages.find_scene(job, report=print)
    assert own.read_text() == "mine"
    assert calls == []


def test_workers_are_strict_if_the_command_is(tmp_path):
    write_model(tmp_path / "in/sparse/0", ["a.png", "b.png"], text=True, rigs=False)
    write_picture(tmp_path / "in/images/a.png")
    images = tmp_path / "in/sparse/0/images.txt"
    lines = images.read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if line.endswith("b.png"))
    lines[number] = " ".join([*lines[number].split()[:5], "nan", *lines[number].split()[6:]])
    images.write_text("\n".join(lines) + "\n")
    with hear(print, strict=True):
        options = BatchOptions()
    job = Job(str(tmp_path / "in"), str(tmp_path / "out"), options)
    with pytest.raises(SceneError, match=tells("nothing broken (strict)", "b.png", "without --strict")):
        stages.find_scene(job, report=print)
    assert stages.find_scene(replace(job, options=BatchOptions()), report=print)["views"] == {"train": 1}


def test_a_killed_search_for_cameras_is_repeated(photos):
    job, calls = photos
    for _ in range(2):
        with pytest.raises(Killed):
            stages.find_scene(job, report=print)
    assert calls == ["sfm", "sfm"]


@pytest.mark.parametrize("kind", ["folder", "memory"])
def test_another_share_goes_on_where_a_killed_batch_stopped(tmp_path, kind):
    names = "abcde"
    for i, name in enumerate(names):
        paint(tmp_path / "scene" / f"{name}.png", i)
    pictures, lines = [[name, f"{name}.png"] for name in names], []
    out = str(tmp_path / "run") if kind == "folder" else f"memory://{tmp_path.name}"
    job = Job(str(tmp_path / "scene"), out, BatchOptions(teacher="tiny_teacher:Tiny"))
    stages.encode_part(job, pictures[:2], report=print)
    stages.encode_part(job, pictures[2:4], report=print)  # the third of three was not made
    for part in (pictures[:3], pictures[3:]):
        assert not stages.encode_part(job, part, report=lines.append)["reused"]
    assert [line.partition(" by ")[0] for line in lines] == [
        "features: 3 maps found, 0 to make",
        "features: 1 maps found, 1 to make",
    ]
    assert stages.join_parts(job, "key", list(names), 0.0, report=print)["maps"] == 5
    with open_place(out) as place:
        assert sorted(name for name in place.listing() if name.startswith("features/")) == [
            *(f"features/{name}.npy" for name in names),
            "features/features.json",
        ]


def test_links_in_circles_end_and_each_folder_is_listed_once(tmp_path):
    scene = tmp_path / "scene"
    paint(scene / "images" / "sub" / "a.png", 0)
    paint(tmp_path / "depth" / "b.png", 1)
    (tmp_path / "depth" / "back").symlink_to(scene)
    for name, target in {"again": ".", "all": "images", "images/up": "..", "depth": "../depth", "z": "z"}.items():
        (scene / name).symlink_to(target if name != "images/up" else scene)
    assert list(Place(scene).listing()) == ["depth/b.png", "images/sub/a.png"]


def test_a_picture_outside_of_its_scene_has_a_version(tmp_path):
    """A transforms.json may name it; and a folder that is listed under another name has files, too."""
    paint(tmp_path / "elsewhere" / "a.png", 0)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "b").symlink_to("../elsewhere")
    (tmp_path / "scene" / "c").symlink_to("../elsewhere")
    names, place = [str(tmp_path / "elsewhere" / "a.png"), "c/a.png", "d.png"], Place(tmp_path / "scene")
    assert list(place.listing()) == ["b/a.png"]
    before = place.marks(names)
    paint(tmp_path / "elsewhere" / "a.png", 1)
    after = place.marks(names)
    assert [old != new for old, new in zip(before, after, strict=True)] == [True, True, False]
    assert before[2] == ["d.png", None]


def test_a_url_has_no_lock_and_the_command_says_so(scene, tmp_path, capsys, monkeypatch):
    from contextlib import contextmanager

    import kfgs.scale

    class Client(Idle):
        cluster = "none"

    @contextmanager
    def opened(**_):
        yield Client()

    monkeypatch.setattr(kfgs.scale, "open_client", opened, raising=False)
    (tmp_path / "scenes.txt").write_text("captures/kitchen\n")
    for out, noted in ((f"memory://{tmp_path.name}", True), (str(tmp_path / "runs"), False)):
        with open_place(f"{out}/kitchen") as place:
            place.write_text("state.json", OURS["state.json"])
        assert main(["batch", str(tmp_path / "scenes.txt"), "--out", out]) == 1  # the failure of before
        assert ("has no lock" in capsys.readouterr().out) is noted
    shutil.rmtree(tmp_path / "runs")


@pytest.mark.parametrize(
    "damage",
    [
        {"result": None}, {"result": {}}, {"result": {"gaussians": 1}}, {"result": [1]}, {"files": None},
        {"files": ["field"]}, {"files": {"field": [1]}}, {"key": None},
    ],
)  # fmt: skip
def test_a_damaged_note_of_a_finished_stage_counts_as_not_done(tmp_path, damage):
    place, made = Place(tmp_path), []

    def make():
        (tmp_path / "field.kfgs").write_text("numbers")
        made.append(len(made))
        return {"gaussians": 7, "latents": 3}

    def stage():
        found = stages._stage(place, "fit", "key", ("field",), (), make)
        assert found.pop("seconds") > 0
        return found

    first, again = stage(), stage()
    assert (first["reused"], again, made) == (False, first | {"reused": True}, [0])
    file = tmp_path / "done" / "fit.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | damage))
    assert stage() == first
    assert stage() == again  # it was repaired
    assert made == [0, 1]
    file.write_text(json.dumps({name: one for name, one in json.loads(file.read_text()).items() if name not in damage}))
    assert stage() == first
