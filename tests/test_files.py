"""Files are whole or absent, whatever happens to their writer; JSON, texts, digests, outputs and locks."""

import ast
import codecs
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from killed import kill_everywhere
from messages import refused, tells

import kfgs
from kfgs._files import (
    ASIDE,
    Names,
    atomic_folder,
    atomic_path,
    check_output,
    digest_file,
    digest_value,
    locked,
    read_json,
    read_text,
    write_json,
)

ROOT = Path(kfgs.__file__).parent


def visible(folder: Path) -> dict[str, str]:
    """The files of a folder that are not what a killed writer left."""
    files = (path for path in folder.rglob("*") if path.is_file() and ASIDE not in str(path))
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


# Writing


def test_at_every_kill_a_file_is_old_or_new(tmp_path):
    code = """
from kfgs._files import atomic_path
def prepare(folder): (folder / "a.txt").write_text("old")
def work(folder):
    with atomic_path(folder / "a.txt") as new:
        new.write_text("new")
"""
    states = [visible(folder)["a.txt"] for folder in kill_everywhere(code, tmp_path / "kills")]
    assert set(states) == {"old", "new"}
    assert states == sorted(states, reverse=True)


def test_at_every_kill_a_new_folder_is_whole_or_absent(tmp_path):
    code = """
from kfgs._files import atomic_folder
def prepare(folder): pass
def work(folder):
    with atomic_folder(folder / "stage") as new:
        (new / "a.txt").write_text("a")
        (new / "deep").mkdir()
        (new / "deep" / "b.txt").write_text("b")
"""
    states = [visible(folder) for folder in kill_everywhere(code, tmp_path / "kills")]
    whole = {"stage/a.txt": "a", "stage/deep/b.txt": "b"}
    assert all(state in ({}, whole) for state in states)
    assert states[0] == {}
    assert states[-1] == whole


def test_a_folder_with_files_keeps_what_the_new_ones_do_not_replace(tmp_path):
    for name in ("mine.txt", "a.txt", "deep/mine.txt"):
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_text("mine")
    with atomic_folder(tmp_path / "out") as new:
        (new / "deep").mkdir()
        for name in ("a.txt", "deep/b.txt"):
            (new / name).write_text("new")
    files = {"mine.txt": "mine", "a.txt": "new", "deep/mine.txt": "mine", "deep/b.txt": "new"}
    assert visible(tmp_path / "out") == files
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


@pytest.mark.parametrize("write", [atomic_path, atomic_folder])
def test_a_writer_that_fails_leaves_nothing(tmp_path, write):
    def fail():
        with write(tmp_path / "out" / "a") as new:
            (new / "b" if new.is_dir() else new).write_text("half")
            raise ValueError("half-way")

    refused(fail, "half-way")
    assert list((tmp_path / "out").iterdir()) == []


def test_permissions_are_those_of_any_new_file(tmp_path):
    code = """
import os, pathlib, sys
os.umask(0o027)
from kfgs._files import atomic_folder, atomic_path
with atomic_path(pathlib.Path("a")) as new:
    new.touch(0o600)  # as safetensors does
with atomic_folder(pathlib.Path("b")) as new:
    (new / "c").touch(0o600)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)
    modes = [oct((tmp_path / name).stat().st_mode & 0o777) for name in ("a", "b", "b/c")]
    assert modes == ["0o640", "0o750", "0o640"]


def test_errors_of_writing_name_the_output(tmp_path, monkeypatch):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match=tells(tmp_path / "folder")) as caught, atomic_path(tmp_path / "folder") as new:
        new.touch()
    assert ASIDE not in str(caught.value)
    with pytest.raises(OSError, match=tells("No space left", tmp_path / "a")), atomic_path(tmp_path / "a") as new:
        raise OSError(28, "No space left on device")
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=tells(tmp_path / "file" / "a")), atomic_path(tmp_path / "file" / "a"):
        pass


def test_two_writers_of_one_file_both_succeed(tmp_path):
    code = "import sys; from kfgs import _files\nfor i in range(80): _files.write_json('a', [int(sys.argv[1])] * 100)"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(i)], cwd=tmp_path) for i in range(2)]
    values = set()
    while any(writer.poll() is None for writer in writers):
        if (tmp_path / "a").exists():
            values.add(len(set(read_json(tmp_path / "a"))))
    assert [writer.returncode for writer in writers] == [0, 0]
    assert values <= {1}


# Outputs and paths


def test_what_can_be_written_is_returned_and_nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "old").mkdir()
    (tmp_path / "old.ply").touch()
    for name in ("old", "new/deep", "old.ply", "new/deep.ply"):
        kind = "a file" if name.endswith(".ply") else "a folder"
        assert check_output("out", f"~/{name}", kind) == tmp_path / name
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["old", "old.ply"]


def test_what_cannot_be_written_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    for path, kind, words in (
        (tmp_path, "a file", "got a folder"),
        (tmp_path / "file", "a folder", "got a file"),
        (tmp_path / "file" / "a", "a file", "below the file"),
        (tmp_path / "pipe", "a file", "got a pipe or a device"),
        ("", "a file", "empty"),
    ):
        refused(lambda kind=kind, path=path: check_output("out", path, kind), words)


def test_no_public_function_reads_a_path_in_another_way():
    """A parameter that is a text or a path goes through `as_path`, so that `~` never becomes a folder of that name."""
    wrong = []
    for file in ROOT.rglob("*.py"):
        for function in ast.walk(ast.parse(file.read_text())):
            if not isinstance(function, ast.FunctionDef) or file.name == "_files.py":
                continue
            arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
            paths = {a.arg for a in arguments if a.annotation and "str | Path" in ast.unparse(a.annotation)}
            for call in ast.walk(function):
                is_path = isinstance(call, ast.Call) and ast.unparse(call.func) == "Path" and call.args
                if is_path and ast.unparse(call.args[0]) in paths:
                    wrong.append(f"{file.relative_to(ROOT)}:{call.lineno}")
    assert wrong == []


# Locks

HOLD = """
import sys, time, pathlib
from kfgs._files import locked
with locked(pathlib.Path(sys.argv[1]), "lock"):
    print("held", flush=True)
    time.sleep(100)
"""


def test_the_second_process_is_told_and_a_kill_frees_the_lock(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "run"], stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        with (
            pytest.raises(ValueError, match=tells(f"{tmp_path / 'run'}: ", "in use")),
            locked(tmp_path / "run", "lock"),
        ):
            pass
        first.send_signal(signal.SIGKILL)
    with locked(tmp_path / "run", "lock"):
        pass


# JSON, texts, digests, words


def test_json_refuses_what_json_cannot_hold(tmp_path):
    write_json(tmp_path / "value.json", 1)
    refused(lambda: write_json(tmp_path / "value.json", {"loss": math.nan}), "JSON")
    assert read_json(tmp_path / "value.json") == 1


@pytest.mark.parametrize("content", [b'{"a": 1', b"\xff\xfe{}", b"\xff{}", b"", b"1" * 5000, b"[" * 100_000])
def test_broken_json_names_the_file(tmp_path, content):
    (tmp_path / "split.json").write_bytes(content)
    refused(lambda: read_json(tmp_path / "split.json"), "split.json:", "JSON")
    refused(lambda: read_json(tmp_path / "none.json"), "none.json:", "no such file", "JSON", error=FileNotFoundError)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_texts_and_json_are_read_with_any_mark(encoding: str, tmp_path) -> None:
    (tmp_path / "a.txt").write_bytes("K\u00fcche\r\nFlur\r\n".encode(encoding))
    (tmp_path / "a.json").write_bytes('{"K\u00fcche": 1}'.encode(encoding))
    assert read_text(tmp_path / "a.txt") == "K\u00fcche\nFlur\n"
    assert read_json(tmp_path / "a.json") == {"K\u00fcche": 1}


def test_another_encoding_is_refused_in_words(tmp_path) -> None:
    file = tmp_path / "a.txt"
    file.write_bytes("K\u00fcche".encode("latin-1"))
    with pytest.raises(ValueError, match=r"a\.txt: expected a list in UTF-8, got other bytes \(.*\); save it as UTF-8"):
        read_text(file, "a list")
    file.write_bytes(codecs.BOM_UTF16_LE + b"a")
    refused(lambda: read_text(file, "a list"), "save it as UTF-8")


def test_digests_are_sha256(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert digest_file(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert digest_value({"b": 1, "a": [2]}) == hashlib.sha256(json.dumps({"a": [2], "b": 1}).encode()).hexdigest()


# Names of pictures


@pytest.mark.parametrize(
    ("asked", "there", "meant"),
    [
        ("A.JPG", ["A.jpg", "B.jpg"], "A.jpg"),
        ("a.jpg", ["A.jpg", "B.jpg"], "A.jpg"),
        ("A.JPG", ["A.png"], "A.png"),
        ("A.heic", ["A.jpg", "B.jpg"], "A.jpg"),
        ("A", ["A.jpg", "AB.jpg"], "A.jpg"),
        ("A.jpg", ["A.jpg.png"], "A.jpg.png"),  # a mask of COLMAP
        ("left\\a.png", ["left/a.png", "right/a.png"], "left/a.png"),
        ("K\u00fcche/1.png", ["Ku\u0308che/1.png"], "Ku\u0308che/1.png"),
        ("Ku\u0308che.png", ["k\u00fcche.PNG"], "k\u00fcche.PNG"),
        ("./images/a.png", ["a.png"], "a.png"),
        ("C:\\me\\images\\a.png", ["images/a.png", "b/a.png"], "images/a.png"),
        ("shot.5", ["shot.5.png", "shot.6.png"], "shot.5.png"),
        ("a.png", ["A.png", "A.PNG"], None),  # not clear which
        ("A.jpg", ["A.png", "A.tif"], None),
        ("shot.5", ["shot.png"], None),  # .5 is no ending
        ("a.png", ["masks/a.png"], None),  # of another folder
        ("left/a.png", ["right/a.png"], None),
        ("", ["a.png"], None),
    ],
)
def test_a_name_is_found_as_it_was_respelled(asked: str, there: list[str], meant: str | None) -> None:
    assert Names(there).find(asked) == meant


def test_the_exact_name_wins_over_one_that_differs_in_case() -> None:
    names = Names(["a.png", "A.png", "a.jpg"])
    assert [names.find(name) for name in ("a.png", "A.png", "a.jpg", "A.jpg")] == ["a.png", "A.png", "a.jpg", "a.jpg"]


def test_names_of_views_may_lack_their_folder_where_only_one_fits() -> None:
    names = Names(["left/a.png", "right/a.png", "left/b.png"], bare=True)
    for name, meant in (("b.png", "b"), ("b", "b"), ("a.png", None), ("left/a", "a"), ("images/left/a.png", "a")):
        assert names.find(name) == (meant and f"left/{meant}.png")
    assert names.find("right/b.png") is None  # of another folder


def test_what_several_find_is_only_for_one_that_is_spelled_so() -> None:
    assert Names(["a.png", "b.png"]).find_each(["left/a.png", "right/a.png", "left/b.jpg"]) == [None, None, "b.png"]
    assert Names(["a.png"]).find_each(["a.png", "right/a.png"]) == ["a.png", None]


def test_the_nearest_name_is_the_advice() -> None:
    assert Names(["rgb_1.png", "rgb_12.png", "depth.png"]).advice("DETH") == "did you mean 'depth.png'?"
    assert Names([]).advice("a") == "there are no names to choose from"
