"""Files that kfgs has written, of every format and version, are read with the same numbers; newer versions are refused."""

import gzip
import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from oracles_precision import assert_within
from oracles_sog import pack, unpack

from kfgs.fields import SemanticField
from kfgs.fields.checkpoint import read_checkpoint
from kfgs.formats import find_format, read_splats
from kfgs.formats.order import morton_order
from kfgs.labels import EditList, load_label_set
from kfgs.quant import Autoencoder, Codebook, IndexMaps

HERE = Path(__file__).parent
DATA = HERE / "data"
found = importlib.util.spec_from_file_location("golden_make", HERE / "make.py")
golden = importlib.util.module_from_spec(found)
found.loader.exec_module(golden)

SPLATS = [path.name for path in golden.readable(DATA / "splats")]
FIELDS = [path.name for path in golden.readable(DATA / "fields")]
FOREIGN = {"v1.spz", "v1.sog", "level0.ksplat", "level1.ksplat", "level2.ksplat"}  # not written by kfgs from the cloud


@pytest.fixture(scope="module")
def today(tmp_path_factory):
    """The files as they are written now."""
    folder = tmp_path_factory.mktemp("golden") / "data"
    golden.make(folder)
    return folder


def test_all_numbers_are_read_as_on_the_first_day():
    expected, now = golden.load_numbers(DATA / "numbers.npz"), golden.numbers(DATA)
    assert list(expected) == list(now)
    assert len(expected) > 200
    for name, values in expected.items():
        if isinstance(values, np.ndarray):
            np.testing.assert_allclose(now[name], values, rtol=1e-5, atol=1e-6, err_msg=name)
        else:
            assert now[name].tolist() == values, name


def test_every_file_is_small_and_still_made(today):
    names = {path.relative_to(DATA).as_posix() for path in DATA.rglob("*") if path.is_file()}
    assert names == {path.relative_to(today).as_posix() for path in today.rglob("*") if path.is_file()}
    assert sum((DATA / name).stat().st_size for name in names) < 200_000


@pytest.mark.parametrize("name", sorted(set(SPLATS) - FOREIGN))
@pytest.mark.parametrize("day", ["first", "today"])
def test_splats_hold_the_cloud_that_was_written(today, day, name):
    path = (DATA if day == "first" else today) / "splats" / name
    splats, format = read_splats(path), find_format(path)
    cloud = golden.cloud()
    if getattr(format, "SORTS", False):
        cloud = cloud.select(morton_order(cloud.gaussians.means))
    stated = format.precision(golden.cloud().gaussians)
    if isinstance(stated.means, torch.Tensor):
        stated = stated._replace(means=stated.means[morton_order(golden.cloud().gaussians.means)])
    if name != "v2.spz":  # keeps rotations as three bytes, less exactly than today's version
        assert_within(splats.gaussians, cloud.gaussians, stated)
    assert splats.classes == golden.CLASSES
    assert torch.equal(splats.gaussians.labels, cloud.gaussians.labels)
    np.testing.assert_allclose(splats.extra["score"], cloud.extra["score"])


@pytest.mark.parametrize("name", ["v1", "v2", "v3", "v3_paper", "lossless.kfgs.safetensors"])
@pytest.mark.parametrize("day", ["first", "today"])
def test_fields_hold_every_bit_that_was_written(today, day, name):
    loaded = SemanticField.load((DATA if day == "first" else today) / "fields" / name)
    made = golden.field("fused" if name in ("v3", "lossless.kfgs.safetensors") else "adc+sc")
    for part, values in made.gaussians.to_numpy().items():
        assert np.array_equal(loaded.gaussians.to_numpy()[part], values), part
    if name.startswith(("v1", "v2")):
        assert (loaded.info, loaded.linear, loaded.seen, loaded.words) == ({"a": 1}, None, None, None)
    else:
        assert loaded.info["views"] == ["erste", "second"]
        assert [camera.near for camera in loaded.cameras] == [camera.near for camera in made.cameras]
        assert loaded.label_set().names == golden.CLASSES


def newer_json(path: Path, **changes) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def newer_bytes(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert data.count(old) == 1
    path.write_bytes(data.replace(old, new))


def newer_zip(path: Path) -> None:
    files = unpack(path)
    pack(path, files | {"meta.json": json.dumps(json.loads(files["meta.json"]) | {"version": 3}).encode()})


def newer_gzip(path: Path) -> None:
    data = gzip.decompress(path.read_bytes())
    path.write_bytes(gzip.compress(data[:4] + (9).to_bytes(4, "little") + data[8:]))


VERSION = (b'"version":"1"', b'"version":"2"')
NEWER = {
    "splats/cloud.ply": (lambda path: newer_bytes(path, b"endian 1.0", b"endian 2.0"), ("1.0", "2.0")),
    "splats/v4.spz": (lambda path: newer_bytes(path, b"NGSP\x04", b"NGSP\x05"), ("version", "5")),
    "splats/v3.spz": (newer_gzip, ("version", "9")),
    "splats/cloud.sog": (newer_zip, ("version", "3")),
    "splats/cloud.glb": (lambda path: newer_bytes(path, b"glTF\x02", b"glTF\x03"), ("version 2", "3")),
    "splats/cloud.gltf": (lambda path: newer_json(path, asset={"version": "3.0"}), ("glTF 2.0", "'3.0'")),
    "splats/level1.ksplat": (lambda path: path.write_bytes(b"\x01\x00" + path.read_bytes()[2:]), ("0.1", "1.0")),
    "fields/v3": (lambda path: newer_json(path / "field.json", version=4), ("version 1 or 2 or 3", "got 4", "kfgs")),
    "fields/small.kfgs.safetensors": (
        lambda path: newer_bytes(path, b'\\"version\\": 1', b'\\"version\\": 7'),
        ("format version 1", "got 7", "use the kfgs that wrote it"),
    ),
    "others/words.safetensors": (lambda path: newer_bytes(path, *VERSION), ("label set, version 1", "got version 2")),
    "others/codebook.safetensors": (lambda path: newer_bytes(path, *VERSION), ("codebook, version 1", "got version 2")),
    "others/autoencoder.safetensors": (lambda path: newer_bytes(path, *VERSION), ("version 1", "got version 2")),
    "others/index_maps.safetensors": (lambda path: newer_bytes(path, *VERSION), ("version 1", "got version 2")),
    "others/checkpoint.safetensors": (lambda path: newer_bytes(path, *VERSION), ("version 1", "got version 2")),
    "others/edits.json": (lambda path: newer_json(path, version=2), ("version 1", "got 2", "install the kfgs")),
}
READERS = {
    "words": load_label_set,
    "codebook": Codebook.load,
    "autoencoder": Autoencoder.load,
    "index_maps": IndexMaps.load,
    "checkpoint": lambda path: read_checkpoint(path, golden.IDENTITY),
    "edits": EditList.load,
}


@pytest.mark.parametrize("name", NEWER)
def test_a_newer_version_is_a_clear_error(tmp_path, name):
    bend, told = NEWER[name]
    path = tmp_path / Path(name).name
    (shutil.copytree if (DATA / name).is_dir() else shutil.copy)(DATA / name, path)
    kind = name.partition("/")[0]
    read = {"splats": read_splats, "fields": SemanticField.load}.get(kind) or READERS[path.name.partition(".")[0]]
    read(path)  # as it is, it can be read
    bend(path)
    with pytest.raises(ValueError, match=tells(path.name, "expected", *told)):
        read(path)
