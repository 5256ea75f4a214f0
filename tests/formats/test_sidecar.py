import json
import zipfile

import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from messages import refused

from kfgs import Gaussians
from kfgs.formats import read_splats, write_splats
from kfgs.formats.sidecar import LABELS, NAMES, beside, read_names, write_names

CLASSES = ("wall", "Stuhl ä", "plant")


def _splats(n: int = 6) -> Gaussians:
    return random_cloud(n, 0, labels=torch.arange(n) % 4 - 1, scores=np.linspace(0, 1, n), names=CLASSES)


@pytest.fixture
def path(tmp_path):
    """A .splat file, which has no place for labels, with its labels beside it."""
    assert write_splats(_splats(), tmp_path / "a.splat").paths == [
        tmp_path / "a.splat", tmp_path / "a.splat.labels.npz", tmp_path / "a.splat.classes.json"
    ]  # fmt: skip
    return tmp_path / "a.splat"


def _bend(path, **changes):
    with np.load(beside(path, LABELS)) as file:
        arrays = dict(file) | changes
    np.savez(beside(path, LABELS), **{name: value for name, value in arrays.items() if value is not None})


def test_without_them_the_file_still_opens(path):
    beside(path, LABELS).unlink()
    beside(path, NAMES).unlink()
    back = read_splats(path)
    assert back.labels is None
    assert (back.names, back.extra) == ((), {})


def test_labels_without_names_and_scores(path):
    beside(path, NAMES).unlink()
    _bend(path, score=None)
    back = read_splats(path)
    assert back.labels.tolist() == [-1, 0, 1, 2, -1, 0]
    assert (back.names, back.extra) == ((), {})


def test_scores_that_are_no_numbers_are_0_as_in_a_ply(path, notes):
    _bend(path, score=np.array([0.5, np.nan, 0.5, np.inf, 0.5, 0.5]))
    back = read_splats(path)
    assert back.scores.tolist() == [0.5, 0, 0.5, 0, 0.5, 0.5]
    assert back.labels.tolist() == [-1, 0, 1, 2, -1, 0]
    assert "2 of 6 Gaussians have no number as score (rows 1, 3): read as 0" in notes[-1]


def test_labels_of_another_version_are_refused(path):
    content = path.read_bytes()
    path.write_bytes(content[32:] + content[:32])  # the same Gaussians in another order
    refused(lambda: read_splats(path), "labels.npz", "a.splat", "another")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"class_id": np.zeros(5, np.int32)}, ("labels", "5")),
        ({"class_id": np.zeros(6, np.float32)}, ("class_id", "float32")),
        ({"class_id": np.full(6, "a")}, ("class_id", "<U1")),
        ({"class_id": np.full(6, -2)}, ("class_id", "-1")),
        ({"class_id": None}, ("class_id", "delete")),
        ({"of": None}, ("of", "delete")),
        ({"of": np.array("other")}, ("a.splat", "another version")),
        ({"score": np.zeros(7)}, ("scores", "7")),
        ({"score": np.zeros(100_000)}, ("800664 bytes", "6 Gaussians")),
        ({"class_id": np.array([None] * 6)}, ("read", "a.splat")),  # pickled objects are never loaded
    ],
)
def test_damaged_labels_are_named(path, changes, message):
    _bend(path, **changes)
    refused(lambda: read_splats(path), "a.splat.labels.npz:", *message)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"hello" * 100, np.arange(6).tobytes()])
def test_what_is_no_archive_is_named(path, content):
    beside(path, LABELS).write_bytes(content)
    refused(lambda: read_splats(path), "a.splat.labels.npz:", "read", "delete")


def test_an_archive_that_unpacks_to_gigabytes_is_not_unpacked(path):
    with zipfile.ZipFile(beside(path, LABELS), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("class_id.npy", b"\0" * (64 << 20))
    assert beside(path, LABELS).stat().st_size < 100_000
    refused(lambda: read_splats(path), "a.splat.labels.npz:", "67108864", "6 Gaussians")


def test_names_survive(tmp_path):
    target = write_names(tmp_path / "a.ply", CLASSES, distance=0.1)
    assert target == tmp_path / "a.ply.classes.json"
    assert read_names(target) == CLASSES
    assert json.loads(target.read_text())["distance"] == 0.1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", ("'class_id'", "string")),
        ('{"class_id": {"0": "a", "2": "b"}}', ("'class_id'", "names", "'1'")),
        ('{"class_id": {"0": 5}}', ("names", "got (5,)", "string")),
        ("{", ("JSON",)),
    ],
)
def test_damaged_names_are_named(path, content, message):
    beside(path, NAMES).write_text(content)
    refused(lambda: read_splats(path), "a.splat.classes.json:", *message)


def test_names_of_files_that_share_a_stem_stay_apart(tmp_path):
    write_splats(_splats(), tmp_path / "scene.ply")
    write_splats(_splats().replace(names=("a", "b", "c", "d")), tmp_path / "scene.spz")
    write_splats(_splats().replace(names=()), tmp_path / "scene.splat")
    write_splats(_splats().replace(labels=None), tmp_path / "scene.compressed.ply")
    assert read_splats(tmp_path / "scene.ply").names == CLASSES
    assert read_splats(tmp_path / "scene.spz").names == ("a", "b", "c", "d")
    assert read_splats(tmp_path / "scene.splat").names == ()


def test_labels_and_names_are_found_through_a_link(path):
    link = path.parent / "elsewhere" / "b.splat"
    link.parent.mkdir()
    link.symlink_to(path)
    again = link.with_name("c.splat")
    again.symlink_to(link)
    for place in (link, again):
        found = read_splats(place)
        assert found.names == CLASSES
        assert torch.equal(found.labels, read_splats(path).labels)
        assert found.scores.tolist() == read_splats(path).scores.tolist()
    write_names(link, ("of", "the", "link"))  # what is next to the link comes first
    assert read_splats(link).names == ("of", "the", "link")
    assert read_splats(path).names == CLASSES


def test_writing_to_a_link_leaves_the_file_it_led_to(path):
    link = path.parent / "b.splat"
    link.symlink_to(path)
    write_splats(_splats().replace(labels=None), link)
    assert read_splats(link).labels is None
    assert read_splats(path).names == CLASSES
