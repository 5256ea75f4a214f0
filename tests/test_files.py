import hashlib
import json
import math
import os
import stat

import pytest
import torch
from messages import tells
from safetensors.torch import save_file

from kfgs import _files
from kfgs._files import (
    atomic_folder,
    atomic_path,
    bytes_in_words,
    digest_file,
    digest_value,
    read_json,
    seconds_in_words,
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
        assert temporary.parent == target.parent  # the same disk, so that moving is one step
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
    monkeypatch.setattr(_files, "_UMASK", 0o027)
    monkeypatch.setattr(os, "umask", None)  # not safe while other threads write
    with atomic_path(tmp_path / "file") as temporary:
        temporary.write_bytes(b"")
    with atomic_folder(tmp_path / "folder"):
        pass
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750


def test_private_files_of_other_libraries_become_ordinary(tmp_path, monkeypatch):
    monkeypatch.setattr(_files, "_UMASK", 0o027)
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
        assert _files._read_umask() == 0o077
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


def test_folder_replaces_the_old_one_entirely(tmp_path):
    target = tmp_path / "scene"
    for name in ("old.txt", "new.txt"):
        with atomic_folder(target) as temporary:
            (temporary / name).write_text(name)
    assert names(target) == ["new.txt"]
    assert names(tmp_path) == ["scene"]


def test_failed_folder_leaves_the_old_one(tmp_path):
    target = tmp_path / "scene"
    target.mkdir()
    (target / "old.txt").write_text("old")
    with pytest.raises(RuntimeError, match="killed"):
        write_and_fail(atomic_folder(target), "new.txt")
    assert names(target) == ["old.txt"]
    assert names(tmp_path) == ["scene"]


def test_old_folder_comes_back_when_the_new_one_cannot_be_moved(tmp_path, monkeypatch):
    target = tmp_path / "scene"
    target.mkdir()
    (target / "old.txt").write_text("old")
    replace, moves = os.replace, []

    def second_fails(source, destination):
        moves.append(destination)
        if len(moves) == 2:
            raise OSError("disk gone")
        replace(source, destination)

    monkeypatch.setattr(os, "replace", second_fails)
    with pytest.raises(OSError, match="disk gone"), atomic_folder(target) as temporary:
        (temporary / "new.txt").write_text("new")
    assert names(target) == ["old.txt"]
    assert names(tmp_path) == ["scene"]


def test_json_round_trip(tmp_path):
    value = {"Größe": [1, 2.5, None, True], "nested": {"a": "b"}}
    write_json(tmp_path / "deep" / "value.json", value)
    assert read_json(tmp_path / "deep" / "value.json") == value
    assert (tmp_path / "deep" / "value.json").read_text(encoding="utf-8").endswith("}\n")


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_json_refuses_what_json_cannot_hold(tmp_path, number):
    write_json(tmp_path / "value.json", 1)
    with pytest.raises(ValueError, match=tells("JSON")):
        write_json(tmp_path / "value.json", {"loss": number})
    assert read_json(tmp_path / "value.json") == 1


def test_missing_json(tmp_path):
    with pytest.raises(FileNotFoundError, match=tells("split.json:", "no such file", "JSON")):
        read_json(tmp_path / "split.json")
    with pytest.raises(FileNotFoundError, match=tells("no such file")):
        read_json(tmp_path)  # a folder


@pytest.mark.parametrize("content", [b'{"a": 1', b"\xff\xfe{}", b"", b"1" * 5000])
def test_broken_json_names_the_file(tmp_path, content):
    (tmp_path / "split.json").write_bytes(content)
    with pytest.raises(ValueError, match=tells("split.json:", "JSON", "parsed (")):
        read_json(tmp_path / "split.json")


def test_digests_are_sha256(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert digest_file(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert digest_value({"b": 1, "a": [2]}) == hashlib.sha256(json.dumps({"a": [2], "b": 1}).encode()).hexdigest()


def test_digest_depends_on_the_value_and_not_on_the_order_of_keys():
    assert digest_value({"a": 1, "b": 2}) == digest_value({"b": 2, "a": 1})
    assert digest_value([1, 2]) != digest_value([2, 1])
    assert digest_value(1) != digest_value(1.5)


def test_bytes_and_seconds_in_words():
    assert [bytes_in_words(count) for count in (None, 15_925_248_000, 999e6, 340_000)] == [
        "unknown",
        "15.9 GB",
        "999.0 MB",
        "0.3 MB",
    ]
    times = [seconds_in_words(seconds) for seconds in (None, 40, 89, 720, 11_880)]
    assert times == ["unknown", "40 s", "89 s", "12 min", "3.3 h"]


@pytest.mark.parametrize("pair", ["[]", '{"a":}'], ids=["lists", "objects"])
def test_json_that_nests_too_deep_is_a_clear_error(tmp_path, pair):
    left, right = pair[:-1], pair[-1]
    file = tmp_path / "classes.json"
    for depth in (201, 990, 100_000):
        file.write_text(left * depth + "1" + right * depth)
        with pytest.raises(ValueError, match=tells(file, "JSON", "brackets nest more than 200 deep")):
            read_json(file)
    file.write_text(left * 199 + "1" + right * 199)
    assert read_json(file)
