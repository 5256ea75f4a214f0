import dataclasses
import json
import os
import shutil
from collections.abc import Callable

import pytest
import torch
from killed import kill_everywhere
from messages import tells
from small_room import make_room

from kfgs.features import FeatureFolder
from kfgs.fields import SemanticField
from kfgs.gaussians import Gaussians
from kfgs.pipeline import FitConfig, fit_scene
from kfgs.pipeline.runs import (
    check_current,
    compare_fields,
    find_run_field,
    keep_field,
    list_fields,
    restore_field,
    say_kept,
)
from kfgs.pipeline.stages import LOCK, Run
from kfgs.scenes import load_scene

TINY = """
import torch
from kfgs.fields import SemanticField
from kfgs.gaussians import Gaussians

def tiny_field(number=0):
    means = torch.arange(12.0).view(4, 3) + number
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(4, 1)
    return SemanticField(
        Gaussians(means, quats, torch.full((4, 3), 0.5), torch.full((4,), 0.5), features=torch.eye(4)),
        info={"method": "fuse"},
    )
"""
names: dict[str, Callable[..., SemanticField]] = {}
exec(TINY, names)
tiny_field = names["tiny_field"]


def a_field(number: int, **info: object) -> SemanticField:
    return dataclasses.replace(tiny_field(number), info={"method": "fuse", **info})


@pytest.fixture
def run(tmp_path):
    """A run folder with three fields; the last one is current."""
    for number in range(3):
        keep_field(tmp_path)
        a_field(number, seed=number, steps={"color": 100 * number}).save(tmp_path / "field")
        date = 1_000_000_000 + number
        os.utime(tmp_path / "field" / "field.json", (date, date))
    return tmp_path


def first(path):
    return int(SemanticField.load(path).gaussians.means[0, 0])


def test_fields_are_listed_the_current_one_first_then_the_latest(run):
    fields = list_fields(run)
    assert [field.current for field in fields] == [True, False, False]
    assert [field.info["seed"] for field in fields] == [2, 1, 0]
    assert [first(field.path) for field in fields] == [2, 1, 0]
    assert [field.path.name for field in fields] == ["field", *(f"field@{field.key}" for field in fields[1:])]
    assert str(fields[1]).startswith(f"{fields[1].key}  fuse, ")
    assert "100 steps (color), of 2001-09-" in str(fields[1])


def test_an_earlier_field_comes_back_and_the_current_one_is_kept(run):
    before = list_fields(run)
    restored = restore_field(run, before[2].key[:6])
    assert first(run / "field") == 0
    assert (restored.key, restored.current) == (before[2].key, True)
    after = list_fields(run)
    assert [field.key for field in after] == [before[2].key, before[0].key, before[1].key]
    assert [first(field.path) for field in after] == [0, 2, 1]
    assert restore_field(run, before[2].key).current  # it is: nothing to do
    assert [field.key for field in list_fields(run)] == [field.key for field in after]


def report(folder, text):
    for name in ("report.html", "preview.png"):
        (folder / name).write_text(text)


def test_reports_and_pictures_go_with_their_field(tmp_path):
    for number in range(3):
        keep_field(tmp_path)
        a_field(number).save(tmp_path / "field")
        report(tmp_path, f"field {number}")
    keys = {first(field.path): field.key for field in list_fields(tmp_path)}
    for number in (0, 1, 1, 2):
        restore_field(tmp_path, keys[number])
        assert (tmp_path / "report.html").read_text() == (tmp_path / "preview.png").read_text() == f"field {number}"
        kept = {first(path): (path / "report.html") for path in tmp_path.glob("field@*")}
        assert {n: file.read_text() for n, file in kept.items() if n != number} == {
            n: f"field {n}" for n in range(3) if n != number
        }


def test_a_field_without_a_report_shows_none(run):
    report(run, "field 2")
    restore_field(run, list_fields(run)[1].key)
    assert not (run / "report.html").exists()
    assert not (run / "preview.png").exists()


def test_the_report_stays_if_the_field_turns_out_the_same(tmp_path):
    a_field(1, seconds={"color": 1}).save(tmp_path / "field")
    report(tmp_path, "field 1")
    before = keep_field(tmp_path)
    a_field(1, seconds={"color": 2}, kfgs="9").save(tmp_path / "field")
    say_kept(Run(tmp_path), before)
    assert (tmp_path / "report.html").read_text() == "field 1"
    assert [path.name for path in tmp_path.glob("field@*")] == []


def test_a_field_of_equal_numbers_and_other_notes_is_another_one(run):
    for note in ("mine", "theirs"):
        before = keep_field(run)
        a_field(2, note=note).save(run / "field")
        say_kept(Run(run), before)
    fields = list_fields(run)
    assert [field.info.get("note") for field in fields[:1]] == ["theirs"]
    assert {field.info.get("note") for field in fields[1:]} == {"mine", None}
    assert len({field.key for field in fields}) == 5
    restored = restore_field(run, next(field.key for field in fields if field.info.get("note") == "mine"))
    assert restored.info["note"] == json.loads((run / "field" / "field.json").read_text())["info"]["note"] == "mine"


def test_a_kept_field_is_found_under_another_name_and_not_copied_again(run):
    """Older versions of kfgs named it by its numbers alone; a user may have renamed or copied it."""
    earlier = list_fields(run)[1]
    earlier.path.rename(run / "field@old")
    shutil.copytree(run / "field@old", run / "field@old copy")
    restore_field(run, earlier.key)
    assert keep_field(run).path == run / "field@old"
    assert len(list_fields(run)) == len(list(run.glob("field@*"))) - 1 == 3


REPORTS = (
    TINY
    + """
import dataclasses
from kfgs.pipeline.runs import keep_field, list_fields, restore_field

def prepare(folder):
    for number in range(2):
        keep_field(folder)
        tiny_field(number).save(folder / "field")
        for name in ("report.html", "preview.png"):
            (folder / name).write_text(str(number))

def work(folder):
    restore_field(folder, next(one.key for one in list_fields(folder) if not one.current))
"""
)


def test_at_every_kill_a_report_is_that_of_the_current_field_or_gone(tmp_path):
    folders = kill_everywhere(REPORTS, tmp_path / "kills")
    seen = set()
    for folder in folders:
        shown = {(folder / name).read_text() for name in ("report.html", "preview.png") if (folder / name).exists()}
        seen.add((first(folder / "field"), *shown))
        restore_field(folder, next(one.key for one in list_fields(folder) if first(one.path) == 0))
        assert (folder / "report.html").read_text() == (folder / "preview.png").read_text() == "0"
    assert seen == {(1, "1"), (1,), (0,), (0, "0")}


def test_a_users_files_in_the_field_stay_when_another_one_is_restored(run):
    (run / "field" / "notes.txt").write_text("mine")
    restore_field(run, list_fields(run)[1].key)
    assert (run / "field" / "notes.txt").read_text() == "mine"


def test_a_comparison_names_what_differs_and_nothing_else(run):
    fields = list_fields(run)
    rows = compare_fields(fields[1], fields[0])
    assert rows == [("seed", "1", "2"), ("steps.color", "100", "200")]
    assert compare_fields(fields[0], fields[0]) == []


@pytest.mark.parametrize("what", ["numbers cut", "numbers missing", "text cut", "text is a list", "other numbers"])
def test_a_damaged_copy_does_not_count_as_kept(run, what):
    before = keep_field(run)  # an earlier fit made it, and it was damaged since
    if what == "text is a list":
        (before.path / "field.json").write_text("[]")
    elif what == "other numbers":
        a_field(7).save(before.path)
    else:
        damage(before.path, what)
    assert keep_field(run).key == before.key
    a_field(3).save(run / "field")
    restore_field(run, before.key)
    assert first(run / "field") == 2


def test_a_file_where_the_field_is_kept_is_named_before_the_work(run):
    place = run / f"field@{list_fields(run)[0].key}"
    place.write_text("mine")
    with pytest.raises(FileExistsError, match=tells(place, "a file", "move it")):
        check_current(run)
    assert place.read_text() == "mine"


@pytest.mark.parametrize("key", ["", "field@", "nonsense", "../field"])
def test_an_unknown_key_is_refused_with_those_that_are_there(run, key):
    shutil.rmtree(list_fields(run)[2].path)
    if key == "field@":
        shutil.rmtree(list_fields(run)[1].path)  # the current one is the only one
    with pytest.raises(ValueError, match=tells("key:", *(field.key for field in list_fields(run)), repr(key))):
        find_run_field(run, key)


def test_a_folder_without_fields_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=tells(tmp_path, "kfgs fit")):
        list_fields(tmp_path)


def damage(field, what):
    """Three ways to damage a field."""
    if what == "numbers cut":
        os.truncate(field / "field.safetensors", 100)
    elif what == "numbers missing":
        (field / "field.safetensors").unlink()
    else:
        os.truncate(field / "field.json", 50)


DAMAGES = ["numbers cut", "numbers missing", "text cut"]


def test_a_damaged_field_is_left_out_with_a_warning_and_the_others_are_listed(run):
    fields = list_fields(run)
    damage(fields[1].path, "text cut")
    with pytest.warns(UserWarning, match=tells(fields[1].path, "left out")):
        assert [field.key for field in list_fields(run)] == [fields[0].key, fields[2].key]
    damage(run / "field", "text cut")
    with pytest.warns(UserWarning, match=tells(run / "field", "left out")):
        assert [field.current for field in list_fields(run)] == [False]


@pytest.mark.parametrize("what", DAMAGES[:2])
def test_a_damaged_field_never_takes_the_place_of_a_whole_one(run, what):
    earlier = list_fields(run)[1]
    damage(earlier.path, what)
    with pytest.raises(ValueError, match=tells(earlier.path, "damaged", "delete")):
        restore_field(run, earlier.key)
    assert first(run / "field") == 2


@pytest.mark.parametrize("steps", [3, [1], "many", {"color": "many"}, {"color": None}, None])
def test_steps_that_another_program_wrote_are_left_out(tmp_path, steps):
    a_field(0, steps=steps).save(tmp_path / "field")
    (found,) = list_fields(tmp_path)
    assert str(found).startswith(f"{found.key}  fuse, 4 Gaussians, of ")


def test_a_description_cannot_lead_out_of_the_run_folder(run, tmp_path):
    file = run / "field" / "field.json"
    about = json.loads(file.read_text())
    file.write_text(json.dumps({**about, "sha256": "/../../../ou" + 52 * "t"}))
    with pytest.raises(ValueError, match=tells(run / "field", "sha256")):
        keep_field(run)
    with pytest.warns(UserWarning, match="sha256"):
        assert len(list_fields(run)) == 2


def test_a_users_files_in_an_earlier_field_stay_when_the_same_numbers_come_back(run):
    earlier = list_fields(run)[1]
    restore_field(run, earlier.key)
    (earlier.path / "notes.txt").write_text("mine")
    say_kept(Run(run), keep_field(run))
    assert [path.name for path in earlier.path.iterdir()] == ["notes.txt"]


RESTORE = f"""
{TINY}
from kfgs.pipeline.runs import keep_field, list_fields, restore_field

def prepare(folder):
    tiny_field(0).save(folder / "field")
    (folder / "field" / "notes.txt").write_text("mine")
    keep_field(folder)
    tiny_field(1).save(folder / "field")

def work(folder):
    restore_field(folder, list_fields(folder)[1].key)
"""


def test_at_every_kill_of_a_restore_both_fields_are_there(tmp_path):
    for folder in kill_everywhere(RESTORE, tmp_path / "kills"):
        fields = list_fields(folder)
        assert {first(field.path) for field in fields} == {0, 1}
        assert (folder / "field" / "notes.txt").read_text() == "mine"
        restore_field(folder, next(field.key for field in fields if first(field.path) == 0))
        assert first(folder / "field") == 0


@pytest.fixture(scope="module")
def fuse(tmp_path_factory):
    scene = load_scene(make_room(tmp_path_factory.mktemp("room") / "scene"))
    maps = FeatureFolder(scene.folder / "features", [scene.stem(i) for i in scene.splits["train"]])
    config = FitConfig.cpu()
    return scene, maps, config, tiny_splat(scene)


def tiny_splat(scene):
    points = scene.points[:: len(scene.points) // 50].float()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1)
    return Gaussians(points, quats, torch.full((len(points), 3), 0.3), torch.full((len(points),), 0.9))


def test_a_fit_with_other_options_keeps_the_field_and_says_so(fuse, tmp_path):
    scene, maps, config, splat = fuse
    lines: list[str] = []
    one = fit_scene(scene, maps, tmp_path, config, splat=splat, report=lines.append)
    (one.field_path / "notes.txt").write_text("mine")
    fit_scene(scene, maps, tmp_path, config, splat=splat, report=lines.append)
    assert len(list_fields(tmp_path)) == 1
    assert not any("current" in line for line in lines)
    other = dataclasses.replace(config, uplift=dataclasses.replace(config.uplift, max_gaussians=10))
    two = fit_scene(scene, maps, tmp_path, other, splat=splat, report=lines.append)
    fields = list_fields(tmp_path)
    assert [len(SemanticField.load(field.path)) for field in fields] == [len(two.field), len(one.field)]
    assert len(two.field) != len(one.field)
    (said,) = [line for line in lines if "current" in line]
    assert str(fields[1].path) in said
    assert "kfgs runs" in said
    assert (two.field_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("what", [*DAMAGES, "no field"])
def test_a_field_that_cannot_be_kept_is_named_before_the_work(fuse, tmp_path, what):
    scene, maps, config, splat = fuse
    place = tmp_path / "field"
    if what == "no field":
        place.mkdir()
        (place / "notes.txt").write_text("mine")
    else:
        a_field(0).save(place)
        damage(place, what)
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    with pytest.raises((ValueError, FileExistsError), match=tells(place)):
        fit_scene(scene, maps, tmp_path, config, splat=splat)
    assert not (tmp_path / "stages").exists()
    assert {path.name: path.read_bytes() for path in place.iterdir()} == before


def test_a_second_fit_in_the_folder_is_refused_and_destroys_nothing(fuse, tmp_path):
    scene, maps, config, splat = fuse
    seen = []

    class Second:
        """Maps that start another fit of the same folder when they are read."""

        path, files, stems, identity = maps.path, maps.files, maps.stems, None

        def __len__(self):
            return len(maps)

        def __getitem__(self, i):
            if not seen:
                with pytest.raises(
                    ValueError, match=tells(f"{tmp_path}: ", f"process {os.getpid()}", "wait")
                ) as caught:
                    fit_scene(scene, maps, tmp_path, config, splat=splat)
                seen.append(caught.value)
            return maps[i]

    fit_scene(scene, Second(), tmp_path, config, splat=splat)
    assert seen
    assert len(list_fields(tmp_path)) == 1
    with Run(tmp_path).locked():  # free again
        assert f"process {os.getpid()} of " in (tmp_path / LOCK).read_text()
