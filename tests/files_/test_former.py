import os

import pytest

from kfgs._files import atomic_folder, atomic_path, former


@pytest.fixture(autouse=True)
def forget():
    former._left_in.cache_clear()


def old(path, text="half"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    aged(path, path.parent)
    return path


def aged(*paths):
    for path in paths:
        os.utime(path, (1_000_000_000, 1_000_000_000))


def test_files_that_earlier_versions_left_are_deleted_by_the_writer_of_the_same_name(tmp_path):
    left = old(tmp_path / ".a.ply.k3_x90ab.ply")
    other = old(tmp_path / ".b.ply.k3_x90ab.ply")
    for _ in range(2):
        with atomic_path(tmp_path / "a.ply") as new:
            new.write_text("new")
    assert not left.exists()
    assert other.exists()  # until b.ply is written
    assert (tmp_path / "a.ply").read_text() == "new"


@pytest.mark.parametrize(
    "name", [".a.ply.short.ply", ".a.ply.k3_x90ab.npy", ".a.ply.K3_X90AB.ply", "a.ply.k3_x90ab.ply", ".a.ply.k3_x90ab"]
)
def test_other_names_stay(name, tmp_path):
    mine = old(tmp_path / name)
    with atomic_path(tmp_path / "a.ply") as new:
        new.write_text("new")
    assert mine.read_text() == "half"


def test_what_may_be_in_work_stays(tmp_path):
    (tmp_path / ".a.ply.k3_x90ab.ply").write_text("half")
    with atomic_path(tmp_path / "a.ply") as new:
        new.write_text("new")
    assert (tmp_path / ".a.ply.k3_x90ab.ply").exists()


def fill(folder):
    with atomic_folder(folder) as new:
        for name in ("field.json", "field.safetensors"):
            (new / name).write_text("new")


def test_folders_that_hold_nothing_else_are_deleted(tmp_path):
    left = old(tmp_path / ".field.k3_x90ab" / "field.json").parent
    empty = tmp_path / ".field.abcdefgh"
    empty.mkdir()
    aged(empty)
    fill(tmp_path / "field")
    assert not left.exists()
    assert not empty.exists()


def test_folders_with_anything_else_stay(tmp_path):
    replaced = old(tmp_path / ".field.k3_x90ab.old" / "field.json")  # the only copy, if a process was killed there
    mine = old(tmp_path / ".field.abcdefgh" / "notes.txt")
    elsewhere = old(tmp_path / "elsewhere" / "field.json")
    (tmp_path / ".field.12345678").symlink_to(elsewhere.parent)
    fill(tmp_path / "field")
    assert replaced.exists()
    assert mine.exists()
    assert elsewhere.exists()
