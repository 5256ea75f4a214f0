import os
import shutil
import stat
import subprocess
import sys
from contextlib import nullcontext

import pytest
import torch
from killed import kill_everywhere
from messages import tells
from safetensors.torch import save_file

from kfgs._files import (
    HIDDEN,
    FullDiskError,
    atomic,
    atomic_folder,
    atomic_path,
    current_file,
    finish_writing,
    open_current,
    write_json,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def write_and_fail(block, name):
    with block as temporary:
        (temporary / name).write_bytes(b"half")
        raise RuntimeError("killed")


def test_file_appears_only_when_whole(tmp_path):
    target = tmp_path / "new" / "field.bin"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        assert not target.exists()
        assert temporary.suffix == ".bin"
        assert temporary.name == target.name  # some libraries write it into the file
        assert temporary.parents[2] == target.parent  # the same disk, so that moving is one step
    assert target.read_bytes() == b"half"
    assert names(target.parent) == ["field.bin"]


def test_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "field.bin"
    target.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="killed"):
        write_and_fail(atomic_path(target), "")
    assert target.read_bytes() == b"old"
    assert names(tmp_path) == ["field.bin"]


def test_file_replaces_the_old_one(tmp_path):
    target = tmp_path / "field.bin"
    for content in (b"old", b"new"):
        with atomic_path(target) as temporary:
            temporary.write_bytes(content)
    assert target.read_bytes() == b"new"
    assert names(tmp_path) == ["field.bin"]


def test_permissions_follow_the_umask(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "UMASK", 0o027)
    monkeypatch.setattr(os, "umask", None)  # not safe while other threads write
    with atomic_path(tmp_path / "file") as temporary:
        temporary.write_bytes(b"")
    with atomic_folder(tmp_path / "folder"):
        pass
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750


def test_private_files_of_other_libraries_become_ordinary(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "UMASK", 0o027)
    tensors = {"a": torch.zeros(2)}
    with atomic_path(tmp_path / "a.safetensors") as temporary:
        save_file(tensors, temporary)
    with atomic_folder(tmp_path / "run") as folder:
        (folder / "deep").mkdir()
        save_file(tensors, folder / "deep" / "a.safetensors")
        temporary = folder / "deep" / "private"
        temporary.touch(mode=0o600)
    found = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(found) == 3
    assert {stat.S_IMODE(path.stat().st_mode) for path in found} == {0o640}


def test_umask_is_that_of_the_process():
    before = os.umask(0o077)
    try:
        assert atomic._read_umask() == 0o077
        assert os.umask(0o077) == 0o077  # left as it was
    finally:
        os.umask(before)


def test_folder_appears_only_when_whole(tmp_path):
    target = tmp_path / "deep" / "scene"
    with atomic_folder(target) as temporary:
        (temporary / "a.txt").write_text("a")
        assert not target.exists()
    assert names(target) == ["a.txt"]
    assert names(target.parent) == ["scene"]


def test_a_folder_keeps_what_the_new_one_does_not_replace(tmp_path):
    target = tmp_path / "scene"
    target.mkdir()
    (target / "notes.txt").write_text("mine")
    (target / "mine").mkdir()
    (target / "mine" / "deep.txt").write_text("mine")
    (target / "link").symlink_to("notes.txt")
    for content in ("old", "new"):
        with atomic_folder(target) as temporary:
            (temporary / "a.txt").write_text(content)
    assert names(target) == ["a.txt", "link", "mine", "notes.txt"]
    assert (target / "a.txt").read_text() == "new"
    assert (target / "mine" / "deep.txt").read_text() == (target / "link").read_text() == "mine"
    assert names(tmp_path) == ["scene"]


def test_the_folder_that_a_shell_is_in_stays_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with atomic_folder(".") as temporary:
        (temporary / "a.txt").write_text("a")
    assert os.listdir() == ["a.txt"]


def test_a_link_to_a_folder_stays_one(tmp_path):
    (tmp_path / "disk" / "scene").mkdir(parents=True)
    (tmp_path / "disk" / "scene" / "notes.txt").write_text("mine")
    (tmp_path / "scene").symlink_to("disk/scene")
    with atomic_folder(tmp_path / "scene") as temporary:
        (temporary / "a.txt").write_text("new")
    assert (tmp_path / "scene").is_symlink()
    assert names(tmp_path / "disk" / "scene") == ["a.txt", "notes.txt"]


def test_failed_folder_leaves_the_old_one(tmp_path):
    target = tmp_path / "scene"
    target.mkdir()
    (target / "old.txt").write_text("old")
    with pytest.raises(RuntimeError, match="killed"):
        write_and_fail(atomic_folder(target), "new.txt")
    assert names(target) == ["old.txt"]
    assert names(tmp_path) == ["scene"]


def test_folders_in_folders_are_joined(tmp_path):
    for content in ("old", "new"):
        with atomic_folder(tmp_path / "scene") as temporary:
            (temporary / "images" / content).mkdir(parents=True)
            (temporary / "images" / "a.png").write_text(content)
    assert names(tmp_path / "scene") == ["images"]
    assert names(tmp_path / "scene" / "images") == ["a.png", "new", "old"]
    assert (tmp_path / "scene" / "images" / "a.png").read_text() == "new"


def test_a_folder_in_place_of_a_file_is_refused_before_anything_is_moved(tmp_path):
    (tmp_path / "scene" / "b.txt").mkdir(parents=True)
    (tmp_path / "scene" / "a.txt").write_text("old")
    with pytest.raises(IsADirectoryError, match=tells("b.txt")), atomic_folder(tmp_path / "scene") as temporary:
        [(temporary / name).write_text("new") for name in ("a.txt", "b.txt")]
    assert (tmp_path / "scene" / "a.txt").read_text() == "old"
    assert names(tmp_path / "scene") == ["a.txt", "b.txt"]


@pytest.mark.parametrize("link", [".kfgs-unfinished", ".kfgs-unfinished/waiting", ".kfgs-unfinished/new-x"])
def test_links_in_a_strangers_folder_move_and_delete_nothing_elsewhere(tmp_path, link):
    mine = tmp_path / "mine"
    for name in ("a.txt", ".kfgs-lock", "waiting/a.txt", "new-x/.kfgs-lock", "new-x/a.txt"):
        (mine / name).parent.mkdir(parents=True, exist_ok=True)
        (mine / name).write_text("mine")
    before = {path: path.read_text() for path in mine.rglob("*") if path.is_file()}
    (tmp_path / "folder" / link).parent.mkdir(parents=True)
    (tmp_path / "folder" / "a.txt").touch()
    (tmp_path / "folder" / link).symlink_to(mine)
    expected = nullcontext() if link.endswith("new-x") else pytest.raises(ValueError, match=tells(link, "a link"))
    with expected, atomic_folder(tmp_path / "folder") as temporary:
        (temporary / "a.txt").write_text("new")
    assert {path: path.read_text() for path in mine.rglob("*") if path.is_file()} == before
    assert (tmp_path / "folder" / "a.txt").read_text() == ("new" if link.endswith("new-x") else "")


@pytest.mark.parametrize("link", [".kfgs-unfinished", ".kfgs-unfinished/waiting"])
def test_a_reader_takes_no_waiting_file_behind_a_link(tmp_path, link):
    (tmp_path / "mine" / "waiting").mkdir(parents=True)
    for name in ("a.txt", "waiting/a.txt"):
        (tmp_path / "mine" / name).write_text("mine")
    (tmp_path / "folder" / link).parent.mkdir(parents=True)
    (tmp_path / "folder" / "a.txt").write_text("theirs")
    (tmp_path / "folder" / link).symlink_to(tmp_path / "mine")
    assert current_file(tmp_path / "folder", "a.txt").read_text() == "theirs"
    with pytest.raises(ValueError, match=tells(link, "a link")):
        finish_writing(tmp_path / "folder")


def test_a_folder_in_a_folder_is_not_joined_with_what_a_link_leads_to(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.png").write_text("mine")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "images").symlink_to("../mine")

    def write():
        with atomic_folder(tmp_path / "scene") as new:
            (new / "images").mkdir()
            (new / "images" / "a.png").write_text("new")

    with pytest.raises(ValueError, match=tells("images", "a link")):
        write()
    assert (tmp_path / "mine" / "a.png").read_text() == "mine"


def test_a_file_takes_the_place_of_a_link_and_leaves_what_it_leads_to(tmp_path):
    (tmp_path / "far.bin").write_text("mine")
    (tmp_path / "a.bin").symlink_to("far.bin")
    with atomic_path(tmp_path / "a.bin") as new:
        new.write_text("new")
    assert (tmp_path / "far.bin").read_text() == "mine"
    assert not (tmp_path / "a.bin").is_symlink()
    assert (tmp_path / "a.bin").read_text() == "new"


@pytest.mark.parametrize("linked", [False, True])
def test_a_pipe_is_not_replaced(tmp_path, linked):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    with pytest.raises(ValueError, match=tells("a pipe")), atomic_path(tmp_path / ("link" if linked else "pipe")):
        pass
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize("block", [atomic_path, atomic_folder])
def test_a_folder_that_is_deleted_meanwhile_is_said(tmp_path, block):
    def write():
        with block(tmp_path / "run" / "out") as new:
            shutil.rmtree(tmp_path / "run")
            save_file({"a": torch.zeros(2)}, new if block is atomic_path else new / "a.safetensors")

    parts = tmp_path / "run" / "out", "something else deleted or moved", "start again"
    with pytest.raises(FileNotFoundError, match=tells(*parts)) as caught:
        write()
    assert "kfgs-unfinished" not in str(caught.value)


def test_a_folder_that_is_made_again_is_not_taken_for_a_whole_one(tmp_path):
    """The second file makes the hidden folder again, but the first one is lost."""

    def write():
        with atomic_folder(tmp_path / "out") as new:
            write_json(new / "a.json", 1)
            shutil.rmtree(tmp_path / HIDDEN)
            write_json(new / "b.json", 2)

    with pytest.raises(
        FileNotFoundError, match=tells(tmp_path / "out", "something else deleted or moved", "start again")
    ):
        write()
    assert not (tmp_path / "out").exists()


def test_files_that_came_meanwhile_stay(tmp_path):
    target = tmp_path / "scene"
    with atomic_folder(target) as temporary:
        (temporary / "a.txt").write_text("new")
        target.mkdir()
        (target / "notes.txt").write_text("mine")
    assert names(target) == ["a.txt", "notes.txt"]
    assert names(tmp_path) == ["scene"]


FOLDERS = """
from pathlib import Path
from kfgs._files import atomic_folder

def prepare(folder):
    (folder / "field" / "mine").mkdir(parents=True)
    (folder / "field" / "mine" / "notes.txt").write_text("mine")
    for name in ("a.json", "b.bin", "only_old.bin", "notes.txt"):
        (folder / "field" / name).write_text("old")

def work(folder):
    with atomic_folder(folder / "field") as new:
        for name in ("a.json", "b.bin", "only_new.bin"):
            (new / name).write_text("new")
"""


def test_at_every_kill_the_old_folder_or_the_new_one_is_found_and_nothing_else_is_touched(tmp_path):
    folders = kill_everywhere(FOLDERS, tmp_path / "kills")
    assert len(folders) > 15
    states = []
    for folder in folders:
        field = folder / "field"
        found = {name: current_file(field, name) for name in ("a.json", "b.bin", "only_new.bin")}
        states.append({name: path.read_text() if path.exists() else None for name, path in found.items()})
        assert states[-1] in ({"a.json": "old", "b.bin": "old", "only_new.bin": None}, dict.fromkeys(found, "new"))
        assert (field / "mine" / "notes.txt").read_text() == "mine"
        assert (field / "notes.txt").read_text() == (field / "only_old.bin").read_text() == "old"
        with atomic_folder(field) as new:
            (new / "a.json").write_text("newer")
        left = {"a.json": "newer", "b.bin": states[-1]["b.bin"], "only_old.bin": "old", "notes.txt": "old"}
        left |= {} if states[-1]["only_new.bin"] is None else {"only_new.bin": "new"}
        assert {path.name: path.read_text() for path in field.iterdir() if path.is_file()} == left
        assert sorted(path.name for path in folder.rglob(".*")) == []  # what the killed one left
    assert len({str(state) for state in states}) == 2  # some were killed before, and some after the switch


MADE = """
from kfgs._files import atomic_folder

def prepare(folder):
    pass

def work(folder):
    with atomic_folder(folder / "field") as new:
        (new / "a.json").write_text("new")
"""


def test_the_same_writer_again_sweeps_wherever_it_was_killed(tmp_path):
    """The first one makes the folder, the second one finds it there and works inside it."""
    for folder in kill_everywhere(MADE, tmp_path / "kills"):
        with atomic_folder(folder / "field") as new:
            (new / "a.json").write_text("newer")
        assert (folder / "field" / "a.json").read_text() == "newer"
        assert sorted(path.name for path in folder.rglob(".*")) == []


FILES = """
from kfgs._files import atomic_path

def prepare(folder):
    (folder / "a.bin").write_text("old")

def work(folder):
    with atomic_path(folder / "a.bin") as new:
        new.write_text("new")
"""


def test_at_every_kill_a_file_is_whole_and_the_next_writer_sweeps(tmp_path):
    states = set()
    for folder in kill_everywhere(FILES, tmp_path / "kills"):
        states.add((folder / "a.bin").read_text())
        with atomic_path(folder / "other.bin") as new:  # any writer beside it
            new.write_text("b")
        assert names(folder) == ["a.bin", "other.bin"]
    assert states == {"old", "new"}


def test_what_a_living_writer_has_in_hand_stays(tmp_path):
    with atomic_path(tmp_path / "a.bin") as first:
        first.write_text("first")
        with atomic_path(tmp_path / "a.bin") as second:
            second.write_text("second")
        assert first.read_text() == "first"
    assert (tmp_path / "a.bin").read_text() == "first"
    assert names(tmp_path) == ["a.bin"]


WRITER = """
import sys
from kfgs._files import atomic_folder, atomic_path
for _ in range(150):
    with atomic_path(sys.argv[1] + "/a") as file:
        file.write_text(sys.argv[2])
    with atomic_folder(sys.argv[1] + "/folder") as new:
        for name in "xyz":
            (new / name).write_text(sys.argv[2])
"""


def test_writers_of_one_place_do_not_disturb_each_other(tmp_path):
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, tmp_path, name]) for name in "12345"]
    assert [writer.wait(timeout=250) for writer in writers] == [0] * 5
    assert names(tmp_path) == ["a", "folder"]
    assert names(tmp_path / "folder") == ["x", "y", "z"]
    assert len({(tmp_path / "folder" / name).read_text() for name in "xyz"}) == 1


def put(folder, text, names=("a", "b")):
    with atomic_folder(folder) as new:
        for name in names:
            (new / name).write_text(text)


@pytest.mark.parametrize("fails", [False, True])
def test_files_that_are_replaced_between_two_reads_are_read_again(tmp_path, fails):
    folder, rounds = tmp_path / "scene", []
    put(folder, "old")

    def read(find):
        first = find("a").read_text()
        rounds.append(first)
        if len(rounds) == 1:
            put(folder, "new", ("a", "b", "c"))
            if fails:
                raise ValueError("a and b do not fit")
        return first, find("b").read_text(), find("c").is_file()

    assert open_current(folder, read) == ("new", "new", True)
    assert rounds == ["old", "new"]


def test_a_file_that_comes_or_goes_counts_as_replaced(tmp_path):
    put(tmp_path / "scene", "old")
    rounds = []

    def read(find):
        missing = find("c").is_file()
        if not rounds:
            put(tmp_path / "scene", "new", ("c",))
        rounds.append(missing)
        return missing

    assert open_current(tmp_path / "scene", read) is True
    assert rounds == [False, True]


def test_errors_of_a_folder_that_stays_are_those_of_the_reader(tmp_path):
    def read(find):
        return find("a").read_text()

    with pytest.raises(FileNotFoundError):
        open_current(tmp_path, read)


def test_a_folder_that_never_stays_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "ATTEMPTS", 5)

    def read(find):
        find("a")
        put(tmp_path / "scene", "new")

    put(tmp_path / "scene", "old")
    with pytest.raises(ValueError, match=tells(tmp_path / "scene", "another process", "wait")):
        open_current(tmp_path / "scene", read)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), OSError("796 requested and 286 written")])
def test_a_full_disk_names_the_output(tmp_path, error):
    def write(block):
        with block:
            raise error

    for block in (atomic_path, atomic_folder):
        with pytest.raises(FullDiskError, match=tells(f"{tmp_path / 'out'}: expected space", "free")) as caught:
            write(block(tmp_path / "out"))
        assert "kfgs-unfinished" not in str(caught.value)
    assert names(tmp_path) == []


def test_a_file_inside_a_folder_that_is_written_is_named_by_the_folder(tmp_path):
    def write():
        with atomic_folder(tmp_path / "out") as new, atomic_path(new / "a.bin"):
            raise OSError(28, "No space left on device")

    with pytest.raises(FullDiskError, match=tells(f"{tmp_path / 'out'}: expected space")) as caught:
        write()
    assert "kfgs-unfinished" not in str(caught.value)


LIMITED = """
import resource, signal, sys
import torch
from safetensors.torch import save_file
from kfgs._files import atomic_path
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    with atomic_path(sys.argv[1]) as file:
        save_file({"a": torch.zeros(9999)}, file)
except OSError as error:
    print(error)
"""


def test_a_library_that_cannot_write_names_the_output(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, tmp_path / "a.bin"], capture_output=True, text=True, check=True
    )
    assert str(tmp_path / "a.bin") in done.stdout
    assert "kfgs-unfinished" not in done.stdout
    assert names(tmp_path) == []


def test_errors_name_what_was_asked_for_and_not_what_is_hidden(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for path in (tmp_path / "folder", tmp_path / "file" / "a.bin"):
        with pytest.raises(OSError, match=tells(path)) as caught, atomic_path(path) as file:
            file.write_text("a")
        assert "kfgs-unfinished" not in str(caught.value)


def test_paths_may_begin_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with atomic_path("~/a/b.bin") as file:
        file.write_text("b")
    with atomic_folder("~/a/c") as folder:
        (folder / "d").touch()
    assert names(tmp_path) == ["a"]
    assert names(tmp_path / "a") == ["b.bin", "c"]
