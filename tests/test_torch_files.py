"""Files of torch.save by strangers: nothing in them runs, settings with unknown classes are read, other files are named."""

import os
import pickle
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from messages import refused
from pickled import CONTAINERS, Call, archive, text, zip_of

from kfgs._arrays import plain_tensor, read_torch

GETATTR = b"cbuiltins\ngetattr\n"


def attacks(marker: Path) -> dict[str, bytes]:
    """Pickles that make `marker` if anything in them runs."""
    command = f"touch {marker}"
    imported = GETATTR + b"(cbuiltins\n__import__\n(" + text("os") + b"tR" + text("system") + b"tR"
    return {
        "os.system": pickle.dumps(Call(os.system, command), 2),
        "getattr": imported + b"(" + text(command) + b"tR.",
        "in an allowed call": pickle.dumps(Call(OrderedDict, [["a", Call(os.system, command)]]), 2),
        "dotted": b"\x80\x04\x8c\x05torch\x8c\x17serialization.os.system\x93" + text(command) + b"\x85R.",
    }


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("attack", attacks(Path("x")))
def test_an_attack_runs_nothing_and_imports_nothing(tmp_path, attack, container):
    marker, path = tmp_path / "ran", tmp_path / "weights.ckpt"
    torch.save({"a": torch.ones(1)}, path)
    read_torch(path, "weights")  # torch imports some modules when it reads the first file
    modules = set(sys.modules)
    path.write_bytes(CONTAINERS[container](attacks(marker)[attack]))
    try:
        assert read_torch(path, "weights") is not None  # an object without content
    except ValueError as error:
        assert str(error).startswith(f"{path}: expected weights")  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
    assert not marker.exists()
    assert not {
        name for name in set(sys.modules) - modules if name.split(".")[0] not in ("torch", "numpy", "encodings")
    }


KINDS = {
    "empty": (b"", "cannot be read"),
    "page": (b"\n<!DOCTYPE html>\n<html></html>", "HTML"),
    "pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n", "git lfs pull"),
    "gzip": (b"\x1f\x8b\x08" + b"x" * 50, "unpack it"),
    "index": (b'{"weight_map": {}}', "JSON"),
    "picture": (b"\x89PNG\r\n\x1a\n123", "cannot be read"),
    "zip": (zip_of({"photo.txt": b"hello"}), "cannot be read"),
    "bomb": (zip_of({"a/data.pkl": b"N.", "a/data/0": bytes(80 << 20)}, zipfile.ZIP_DEFLATED), "unpack to"),
    "cut": (archive(pickle.dumps({"a": 1}, 2))[:-40], "cannot be read"),
    "program": (
        zip_of({"n/data.pkl": b"N.", "n/version": b"3\n", "n/constants.pkl": b").", "n/code/t.py": b"import os"}),
        "torchscript",
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_other_and_damaged_files_are_named(tmp_path, kind):
    content, words = KINDS[kind]
    (tmp_path / "a.pt").write_bytes(content)
    refused(lambda: read_torch(tmp_path / "a.pt", "weights"), "a.pt: expected weights", words)


@pytest.mark.parametrize(
    ("value", "words"),
    [(torch.eye(2).to_sparse(), "dense"), (torch.ones(1).expand(1000), "contiguous"), ([1.0], "got list")],
)
def test_what_is_no_plain_tensor_is_refused(value, words):
    refused(lambda: plain_tensor(Path("a.pt"), "means", value), "a.pt", "means", words)
