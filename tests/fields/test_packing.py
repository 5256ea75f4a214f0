"""A field in one file: every decoder and precision comes back within its stated errors, and damaged files are refused."""

import json
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch
import zstandard
from cases_packed import LOSSY, METHODS, assert_same, assert_same_notes, assert_within, field
from messages import refused

from kfgs.fields import SemanticField
from kfgs.fields.packing import SMALL
from kfgs.fields.store import recall_scene, scene_classes
from kfgs.labels import LabelSet


@pytest.fixture
def round_trip(tmp_path):
    def save_and_load(made, precision=None):
        made.save(tmp_path / "a.kfgs", precision)
        return SemanticField.load(tmp_path / "a.kfgs")

    return save_and_load


@pytest.mark.parametrize("method", METHODS)
def test_lossless_gives_back_every_bit_in_the_same_order(tmp_path, round_trip, method):
    made = field(method)
    assert_same(made, round_trip(made))
    assert [path.name for path in tmp_path.iterdir()] == ["a.kfgs"]
    plain = safetensors.torch.load_file(tmp_path / "a.kfgs")  # which any other program reads, too
    assert torch.equal(plain["gaussians.means"], made.gaussians.means)


@pytest.mark.parametrize("precision", LOSSY)
@pytest.mark.parametrize("method", METHODS)
def test_what_is_rounded_stays_within_its_stated_errors(round_trip, tmp_path, method, precision):
    made = field(method)
    back = round_trip(made, precision)
    assert_within(made, back)
    assert_same_notes(made, back)
    assert repr(back) == repr(made)
    assert {name: value for name, value in back.info.items() if name != "rounded"} == made.info
    assert [entry["precision"] for entry in back.info["rounded"]] == [precision]
    data = (tmp_path / "a.kfgs").read_bytes()
    round_trip(made, precision)
    assert data == (tmp_path / "a.kfgs").read_bytes(), "the same bytes each time"


def degenerate():
    n = 60
    one, means = torch.ones(n, 3), torch.randn(n, 3, generator=torch.Generator().manual_seed(1))
    yield "one", field(n=1)
    yield "one of no latents", field(n=1, features=torch.zeros(1, 5))
    yield "all equal", field(n=n, means=one, quats=torch.ones(n, 4), scales=one, features=torch.ones(n, 5))
    yield "one axis", field(n=n, means=means * torch.tensor([1.0, 0, 0]))
    yield "far away", field(n=n, means=means + 1e5)
    yield "one is far away", field(n=n, means=means + 1e9 * (torch.arange(n) == 7)[:, None])
    yield "huge", field(n=n, means=means * 1e15, scales=one * 1e12)
    yield "minute", field(n=n, means=means * 1e-20, scales=one * 1e-25)
    yield "scales of 0", field(n=n, scales=torch.zeros(n, 3))
    yield "opacities at the ends", field(n=n, opacities=torch.linspace(0, 1, n))
    yield "rotations of length 0", field(n=n, quats=torch.zeros(n, 4))
    yield "rotations between two names", field(n=n, quats=torch.eye(4)[torch.arange(n) % 4] + torch.eye(4)[0])
    yield "known to nothing", field(n=n, features=torch.zeros(n, 5))
    yield "short latents", field(n=n, features=torch.randn(n, 5) * torch.logspace(-12, 0, n)[:, None])


@pytest.mark.parametrize("precision", ["fine", "tiny"])
@pytest.mark.parametrize("made", [pytest.param(made, id=name) for name, made in degenerate()])
def test_degenerate_fields_stay_within_their_errors(round_trip, made, precision):
    assert_within(made, round_trip(made, precision))


@pytest.mark.parametrize("precision", [None, *LOSSY])
def test_a_field_of_no_gaussians_comes_back(round_trip, precision):
    assert len(round_trip(field(n=0), precision)) == 0


def test_each_precision_is_smaller_and_all_are_smaller_than_the_numbers(tmp_path):
    g = torch.Generator().manual_seed(0)
    made = field(n=6000, means=torch.rand(6000, 3, generator=g) * torch.tensor([8.0, 6, 0.02]))
    sizes = []
    for precision in (None, *LOSSY):
        made.save(tmp_path / "a.kfgs", precision)
        sizes.append((tmp_path / "a.kfgs").stat().st_size)
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[2] < 6000 * 17


def test_saving_replaces_an_older_field_and_nothing_else(tmp_path):
    path = tmp_path / "a.kfgs"
    field(n=5).save(path)
    field(n=3).save(path, "small")
    whole = path.read_bytes()
    for changes, name in (
        ({"means": torch.full((40, 3), torch.nan)}, "gaussians.means:"),
        ({"opacities": torch.full((40,), 1.5)}, "gaussians.opacities:"),
        ({"scales": torch.full((40, 3), 3.4e38)}, "gaussians.scales:"),
    ):
        refused(lambda changes=changes: field(n=40, **changes).save(path, "small"), name, "finite numbers from")
    refused(lambda: replace(field(), info={"loss": float("nan")}).save(path), "info:", "got Out")
    refused(lambda: field().save(path, "coarse"), "precision:", "fine", "'coarse'")
    assert path.read_bytes() == whole
    assert [file.name for file in tmp_path.iterdir()] == ["a.kfgs"]
    refused(lambda: field().save(tmp_path / "folder"), "path:", ".kfgs")
    (tmp_path / "folder.kfgs").mkdir()
    refused(lambda: field().save(tmp_path / "folder.kfgs"), "path:", "got a folder", error=FileExistsError)


def test_a_precision_of_your_own_is_kept_under_its_own_name(round_trip):
    made = field(n=50)
    back = round_trip(made, replace(SMALL, degrees=0.01))
    assert_within(made, back)
    assert back.info["rounded"][0]["precision"] == "custom"
    assert back.info["rounded"][0]["errors"]["gaussians.quats"] == 0.01
    assert [entry["precision"] for entry in round_trip(back, "tiny").info["rounded"]] == ["custom", "tiny"]
    for changes in ({"means": 0}, {"degrees": 31}, {"latents": float("nan")}):
        refused(lambda changes=changes: replace(SMALL, **changes), next(iter(changes)), "expected a number")


def test_a_run_folder_is_opened_by_its_field(tmp_path):
    field(n=4).save(tmp_path / "run" / "field.kfgs")
    assert len(SemanticField.load(tmp_path / "run")) == 4
    refused(lambda: SemanticField.load(tmp_path / "none"), "none", "a field of kfgs", error=FileNotFoundError)


def test_the_scene_moves_with_the_field(tmp_path):
    scene = tmp_path / "before" / "scene"
    scene.mkdir(parents=True)
    place = tmp_path / "before" / "run" / "field.kfgs"
    replace(field(n=4), info={"scene": str(scene)}).save(place)
    assert recall_scene(SemanticField.load(place).info) == scene
    os.rename(tmp_path / "before", tmp_path / "after")
    moved = SemanticField.load(tmp_path / "after" / "run").info
    assert recall_scene(moved) == tmp_path / "after" / "scene"
    (tmp_path / "after" / "scene").rmdir()
    refused(lambda: recall_scene(moved), "scene:", "pass the scene", error=FileNotFoundError)
    refused(lambda: recall_scene({}), "scene:", "remembers")


def test_classes_of_a_scene_folder(tmp_path):
    assert scene_classes(tmp_path) is None
    words = LabelSet(("wall", "chair"), torch.eye(2, 4))
    words.save(tmp_path / "text.safetensors")
    assert scene_classes(tmp_path).names == ("wall", "chair")
    (tmp_path / "classes.json").write_text(json.dumps(["floor", "plant"]))
    np.save(tmp_path / "text.npy", np.eye(2, 4, dtype=np.float32))
    assert scene_classes(tmp_path, 4).names == ("floor", "plant")
    assert scene_classes(tmp_path, 5) is None  # text of another teacher
    (tmp_path / "text.npy").write_bytes(b"damaged")
    assert scene_classes(tmp_path) is None


def remade(path, change, replaced=("", "")):
    """Edit the JSON of a field's file, with a digest that fits."""
    from kfgs.fields.store import _digest

    tensors = safetensors.torch.load_file(path)
    about = json.loads(zstandard.decompress(tensors.pop("description").numpy().tobytes()))
    change(about)
    about["sha256"] = _digest(tensors, about)
    text = json.dumps(about).replace(*replaced).encode()
    tensors["description"] = torch.frombuffer(bytearray(zstandard.compress(text)), dtype=torch.uint8)
    safetensors.torch.save_file(tensors, path, {"kfgs": "semantic field", "version": "1"})


def entry(name, **changes):
    return lambda about: about["packed"][name].update(changes)


HOSTILE = {
    "a billion rows": entry("gaussians.means", shape=[1 << 39, 3]),
    "more rows than bytes": entry("gaussians.means", shape=[400_000_000, 3]),
    "no shape": entry("gaussians.means", shape=None),
    "another count": entry("gaussians.quats", shape=[299, 4]),
    "an unknown coding": entry("gaussians.means", coding="pickle"),
    "an unknown type": entry("gaussians.labels", dtype="object"),
    "wider numbers": entry("gaussians.quats", width=2),
    "a step in words": entry("gaussians.means", step="wide"),
    "an origin out of reach": entry("gaussians.means", origin=[1e300, 0, 0]),
    "a missing tensor": lambda about: about["packed"].pop("gaussians.means"),
    "a tensor too many": lambda about: about["packed"].update(extra=about["packed"]["gaussians.scales"]),
    "no tensors": lambda about: about.update(packed=[]),
    "cameras without names": lambda about: about.update(cameras=[[1, 2]]),
    "cameras of no size": lambda about: about.update(cameras=[["a", 0, 3, 0.2], ["b", 3, 3, 0.2]]),
    "a camera as large as memory": lambda about: about["cameras"][0].__setitem__(1, 1 << 40),
    "info that is no dictionary": lambda about: about.update(info=[1]),
    "no info": lambda about: about.pop("info"),
    "classes of other names": lambda about: about["classes"].update(names=["one"]),
    "more words than a description may have": lambda about: about.update(info={"a": "b" * (9 << 20)}),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_description_that_lies_is_refused_by_the_name_of_its_file(tmp_path, what):
    path = tmp_path / "stranger.kfgs"
    field().save(path, "small")
    remade(path, HOSTILE[what])
    refused(lambda: SemanticField.load(path), "stranger.kfgs:", "expected")


def test_other_files_and_other_versions_are_named(tmp_path):
    path = tmp_path / "a.kfgs"
    for content in (
        b"",
        b"nonsense",
        struct.pack("<Q", 1 << 62) + b"{}",
        safetensors.torch.save({"a": torch.zeros(2)}),
    ):
        path.write_bytes(content)
        refused(lambda: SemanticField.load(path), "a.kfgs:", "field")
    safetensors.torch.save_file({"a": torch.zeros(2)}, path, {"kfgs": "semantic field", "version": "2"})
    refused(lambda: SemanticField.load(path), "a.kfgs:", "version 2", "kfgs that wrote it")


@pytest.mark.parametrize("precision", [None, "small"])
@pytest.mark.parametrize("method", ["fused", "adc+sc"])
def test_damaged_bytes_are_a_value_error(tmp_path, method, precision):
    path = tmp_path / "a.kfgs"
    made = field(method, n=40)
    made.save(path, precision)
    data, random = path.read_bytes(), np.random.default_rng(5)
    header = 8 + struct.unpack("<Q", data[:8])[0]
    for trial in range(60):
        damaged = bytearray(data)
        reach = header if trial % 2 else len(data)  # half of them in the header
        for _ in range(int(random.integers(1, 4))):
            damaged[int(random.integers(reach))] ^= int(random.integers(1, 256))
        path.write_bytes(damaged[: int(random.integers(len(data)))] if trial % 10 == 0 else damaged)
        with pytest.raises(ValueError, match=r"a\.kfgs: expected"):
            SemanticField.load(path)


def test_info_with_numbers_for_keys_is_read_back_as_json_has_it(tmp_path):
    replace(field("fused"), info={10: 1, 9: 2}).save(tmp_path / "a.kfgs")
    read = SemanticField.load(tmp_path / "a.kfgs").info
    assert (read["10"], read["9"]) == (1, 2)
