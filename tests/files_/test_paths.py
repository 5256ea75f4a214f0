import ast
import os
from pathlib import Path

import pytest
from messages import tells

import kfgs
from kfgs._files import as_path, check_output
from kfgs._files import paths as paths_module

ROOT = Path(kfgs.__file__).parent


def test_home_is_expanded_as_in_a_shell(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert as_path("~/scene") == as_path(Path("~/scene")) == tmp_path / "scene"
    assert as_path("~") == tmp_path
    assert as_path("~no such user/a") == Path("~no such user/a")
    assert as_path("a/~/b~") == Path("a/~/b~")


def test_no_public_function_reads_a_path_in_another_way():
    """A parameter that is a text or a path goes through `as_path`, so that `~` never becomes a folder of that name."""
    found = []
    for file in ROOT.rglob("*.py"):
        if file.parts[len(ROOT.parts)] == "_files":
            continue
        for function in ast.walk(ast.parse(file.read_text())):
            if not isinstance(function, ast.FunctionDef):
                continue
            arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
            given = {a.arg for a in arguments if a.annotation and "str | Path" in ast.unparse(a.annotation)}
            for call in ast.walk(function):
                is_path = isinstance(call, ast.Call) and ast.unparse(call.func) == "Path" and call.args
                if is_path and ast.unparse(call.args[0]) in given:
                    found.append(f"{file.relative_to(ROOT)}:{call.lineno}")
    assert found == []


def refused(path, kind, *parts, error=ValueError, **places):
    with pytest.raises(error, match=tells("out:", path, *parts)) as caught:
        check_output("out", path, kind, **places)
    assert "kfgs-unfinished" not in str(caught.value)


def test_what_can_be_written_is_returned_and_nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "old").mkdir()
    (tmp_path / "old.ply").touch()
    for name, kind in (
        ("old", "a folder"),
        ("old.ply", "a file"),
        ("new/deep", "a folder"),
        ("new/deep.ply", "a file"),
    ):
        assert check_output("out", f"~/{name}", kind) == tmp_path / name
    monkeypatch.chdir(tmp_path)
    assert check_output("out", "new", "a folder") == Path("new")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["old", "old.ply"]


def test_files_and_folders_are_not_mistaken(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "file", "a folder", "got a file")
    refused(tmp_path / "folder", "a file", "got a folder")
    refused(tmp_path / "file" / "deep" / "a", "a file", f"below the file {tmp_path / 'file'}")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that nobody can write to")
def test_what_cannot_be_written_is_named_as_it_was_given():
    refused("/proc/a.ply", "a file", "can be written", error=OSError)
    refused("/proc/deep/run", "a folder", "can be written", error=OSError)


def test_a_file_that_is_read_only_is_refused(tmp_path, monkeypatch):
    (tmp_path / "a.ply").touch(0o444)
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path / "a.ply")  # the superuser may write it
    refused(tmp_path / "a.ply", "a file", "Permission denied", error=OSError)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's full device")
def test_a_full_disk_is_refused(tmp_path, monkeypatch):
    with Path("/dev/full").open("wb", buffering=0) as full:
        monkeypatch.setattr(paths_module.tempfile, "TemporaryFile", lambda **_: full)
        refused(tmp_path / "run", "a folder", "No space left", error=OSError)


def test_pictures_and_maps_stay_apart(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    (tmp_path / "link").symlink_to(images)
    for path in (images, images / "deep" / "run", tmp_path / "link" / "run"):
        refused(path, "a folder", "pictures", apart=[images])
    assert check_output("out", tmp_path / "run", "a folder", apart=[images])
    refused(tmp_path / "link", "a folder", "pictures", other=[None, images])
    assert check_output("out", images / "run", "a folder", other=[None, images])


def test_an_empty_path_is_not_the_current_folder():
    with pytest.raises(ValueError, match=tells("path:", "empty")):
        as_path("")
    refused("", "a folder", "empty")


@pytest.mark.parametrize("place", ["sparse", "sparse/0"])
def test_links_inside_an_output_are_refused_and_the_output_itself_may_be_one(tmp_path, place):
    (tmp_path / "mine").mkdir()
    (tmp_path / "out" / place).parent.mkdir(parents=True)
    (tmp_path / "out" / place).symlink_to(tmp_path / "mine")
    (tmp_path / "link").symlink_to("mine")
    advice = "put the whole output folder there; a link to it may be the output"
    with pytest.raises(ValueError, match=tells(tmp_path / "out" / place, "a link", tmp_path / "mine", advice)):
        check_output("out", tmp_path / "out", "a folder", inside=["sparse/0"])
    assert check_output("out", tmp_path / "link", "a folder", inside=["sparse/0"])
