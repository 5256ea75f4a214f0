"""A field in one file: every method and precision comes back within its stated errors, and strangers' files are refused."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch
import zstandard
from cases_packed import LOSSY, METHODS, assert_same, assert_same_notes, assert_within, field
from messages import tells

from kfgs.fields import Seen, SemanticField, coding, container, pack_field, store, unpack_field
from kfgs.fields.coding import WINDOW, find_before
from kfgs.fields.precision import SMALL

ENDING = ".kfgs.safetensors"


@pytest.mark.parametrize("method", METHODS)
def test_lossless_gives_back_every_bit_in_the_same_order(tmp_path, method):
    made = field(method)
    made.save(tmp_path / f"a{ENDING}")
    back = SemanticField.load(tmp_path / f"a{ENDING}")
    assert_same(made, back)
    assert back.folder == tmp_path / f"a{ENDING}"
    back.save(tmp_path / "folder")
    assert_same(made, SemanticField.load(tmp_path / "folder"))
    assert [path.name for path in sorted(tmp_path.iterdir())] == [f"a{ENDING}", "folder"]


@pytest.mark.parametrize("precision", LOSSY)
@pytest.mark.parametrize("method", METHODS)
def test_what_is_rounded_stays_within_its_stated_errors(method, precision):
    made = field(method)
    data = pack_field(made, precision)
    back = unpack_field(data)
    assert_within(made, back)
    assert_same_notes(made, back)
    assert (back.method, back.channels, back.dim) == (made.method, made.channels, made.dim)
    assert {name: value for name, value in back.info.items() if name != "rounded"} == made.info
    assert [one["precision"] for one in back.info["rounded"]] == [precision]
    assert data == pack_field(made, precision), "the same bytes each time"


def degenerate():
    n = 60
    one, means = torch.ones(n, 3), torch.randn(n, 3, generator=torch.Generator().manual_seed(1))
    yield "one", field(n=1)
    yield "one of no latents", field(n=1, features=torch.zeros(1, 5))
    yield "equal means", field(n=n, means=one * 3)
    yield "all equal", field(n=n, means=one, quats=torch.ones(n, 4), scales=one, features=torch.ones(n, 5))
    yield "one axis", field(n=n, means=means * torch.tensor([1.0, 0, 0]))
    yield "far away", field(n=n, means=means + 1e5)
    yield "one is far away", field(n=n, means=means + 1e9 * (torch.arange(n) == 7)[:, None])
    yield "huge", field(n=n, means=means * 1e15, scales=one * 1e12)
    yield "minute", field(n=n, means=means * 1e-20, scales=one * 1e-25)
    yield "scales of 0", field(n=n, scales=torch.zeros(n, 3))
    yield "one scale of 0", field(n=n, scales=one * torch.tensor([1.0, 0, 1]))
    yield "opacities at the ends", field(n=n, opacities=torch.linspace(0, 1, n))
    yield "rotations of length 0", field(n=n, quats=torch.zeros(n, 4))
    yield "rotations between two names", field(n=n, quats=torch.eye(4)[torch.arange(n) % 4] + torch.eye(4)[0])
    yield "known to nothing", field(n=n, features=torch.zeros(n, 5))
    yield "short latents", field(n=n, features=torch.randn(n, 5) * torch.logspace(-12, 0, n)[:, None])
    yield "one huge latent", field(n=n, features=torch.randn(n, 5) * (1 + 1e9 * (torch.arange(n) == 3)[:, None]))
    yield "nothing seen", SemanticField(**{**vars(field(n=n)), "seen": Seen(torch.zeros(n), torch.zeros(n))})


@pytest.mark.parametrize("precision", LOSSY)
@pytest.mark.parametrize("made", [pytest.param(made, id=name) for name, made in degenerate()])
def test_degenerate_fields_stay_within_their_errors(made, precision):
    assert_within(made, unpack_field(pack_field(made, precision)))


@pytest.mark.parametrize("precision", ["lossless", *LOSSY])
def test_a_field_of_no_gaussians_comes_back(precision):
    made = field(n=0)
    back = unpack_field(pack_field(made, precision))
    assert len(back) == 0
    assert torch.equal(back.linear.basis, made.linear.basis) == (precision == "lossless")


def test_double_precision_is_kept_by_lossless_alone():
    made = field(n=20)
    wide = SemanticField(made.gaussians.to(torch.float64), linear=made.linear.to(torch.float64))
    assert torch.equal(unpack_field(pack_field(wide, "lossless")).features, wide.features)
    assert unpack_field(pack_field(wide, "fine")).features.dtype == torch.float32


def test_each_precision_is_smaller_and_all_are_smaller_than_the_numbers():
    g = torch.Generator().manual_seed(0)
    made = field(n=6000, means=torch.rand(6000, 3, generator=g) * torch.tensor([8.0, 6, 0.02]))
    sizes = [len(pack_field(made, precision)) for precision in ("lossless", *LOSSY)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[2] < 6000 * 17


def test_a_cloud_that_compresses_too_well_is_stored_so_that_its_own_reader_takes_it(monkeypatch):
    monkeypatch.setattr("kfgs._arrays.SPARE", 1 << 12)
    one = torch.ones(20_000, 3)
    same = {"quats": torch.ones(20_000, 4), "scales": one, "opacities": one[:, 0] / 2, "labels": one[:, 0].long()}
    made = field(n=20_000, means=one, features=torch.ones(20_000, 5), **same)
    made = SemanticField(**{**vars(made), "seen": Seen(one[:, 0], one[:, 0])})
    assert_same(made, unpack_field(pack_field(made, "lossless")))


def test_the_row_before_is_the_nearest_of_the_last_ones():
    cells = np.random.default_rng(0).integers(0, 50, (70, 3))
    found = find_before(cells).before
    assert found[0] == 70  # none
    for row in range(1, 70):
        nearest = min(range(row - 1, max(-1, row - 1 - WINDOW), -1), key=lambda i: ((cells[row] - cells[i]) ** 2).sum())
        assert found[row] == nearest


def test_saving_replaces_an_older_file_and_nothing_else(tmp_path):
    path = tmp_path / f"a{ENDING}"
    field(n=5).save(path)
    field(n=3).save(path, precision="small")
    assert len(SemanticField.load(path)) == 3
    whole = path.read_bytes()
    broken = field(n=4, means=torch.full((4, 3), torch.nan))
    for precision in ("lossless", "small"):
        with pytest.raises(ValueError, match=tells("gaussians.means:", "NaN")):
            broken.save(path, precision=precision)
    assert path.read_bytes() == whole
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    other = tmp_path / f"other{ENDING}"
    safetensors.torch.save_file({"thesis": torch.zeros(3)}, other)
    with pytest.raises(FileExistsError, match=tells("path:", "file", "other")):
        field().save(other)
    with pytest.raises(FileExistsError, match=tells("path:", "folder")):
        field().save(path.with_suffix(".safetensors").rename(tmp_path / "plain.safetensors"))


UNREADABLE = {
    "gaussians.opacities": ({"opacities": torch.full((40,), 1.5)}, "0 to 1"),
    "gaussians.scales": ({"scales": torch.full((40, 3), -0.1)}, "-0.1"),
}


@pytest.mark.parametrize("precision", ["lossless", "small"])
@pytest.mark.parametrize("name", UNREADABLE)
def test_what_no_reader_takes_is_not_written(tmp_path, name, precision):
    changes, expected = UNREADABLE[name]
    path = tmp_path / f"a{ENDING}"
    field(n=3).save(path)
    with pytest.raises(ValueError, match=tells(f"{name}:", expected)):
        field(n=40, **changes).save(path, precision)
    assert len(SemanticField.load(path)) == 3


def test_numbers_that_overflow_when_rounded_are_kept_by_lossless_alone():
    made = field(n=40, scales=torch.full((40, 3), 3.4e38))
    assert_same(made, unpack_field(pack_field(made, "lossless")))
    with pytest.raises(ValueError, match=tells("gaussians.scales:", "1e+37", "without loss")):
        pack_field(made, "small")


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int16, torch.int32])
def test_labels_of_every_width_come_back(dtype):
    made = field(n=40, labels=torch.arange(40).to(dtype))
    assert_same(made, unpack_field(pack_field(made, "lossless")))


def test_a_precision_of_your_own_is_kept_under_its_own_name():
    made = field(n=50)
    back = unpack_field(pack_field(made, replace(SMALL, degrees=0.01)))
    assert_within(made, back)
    assert back.info["rounded"][0]["precision"] == "custom"
    assert back.info["rounded"][0]["errors"]["gaussians.quats"] == 0.01
    twice = unpack_field(pack_field(back, "tiny"))
    assert [one["precision"] for one in twice.info["rounded"]] == ["custom", "tiny"]
    for changes in ({"means": 0}, {"degrees": 31}, {"latents": float("nan")}):
        with pytest.raises(ValueError, match=tells(next(iter(changes)), "expected a number")):
            replace(SMALL, **changes)


def test_options_that_do_not_fit_are_named(tmp_path):
    with pytest.raises(ValueError, match=tells("path:", ENDING, "precision")):
        field().save(tmp_path / "folder", precision="small")
    with pytest.raises(ValueError, match=tells("precision:", "lossless", "'coarse'")):
        field().save(tmp_path / f"a{ENDING}", precision="coarse")
    assert not list(tmp_path.iterdir())


def remade(data, change, key="description", replaced=("", "")):
    """A packed field whose description `change` has edited, or whose metadata if the key is "kfgs"; then text is replaced."""
    streams = safetensors.torch.load(data)
    about = json.loads(json.loads(data[8 : 8 + struct.unpack("<Q", data[:8])[0]])["__metadata__"]["kfgs"])
    words = json.loads(zstandard.decompress(streams["description"].numpy().tobytes()))
    change(about if key == "kfgs" else words)
    text = json.dumps(words).replace(*replaced).encode()
    streams["description"] = torch.frombuffer(bytearray(zstandard.compress(text)), dtype=torch.uint8)
    return safetensors.torch.save(streams, metadata={"kfgs": json.dumps(about)})


def entry(name, **changes):
    return lambda words: words["tensors"][name].update(changes)


def nested(words):
    words["info"] = {"deep": "DEEP"}


HOSTILE = {
    "a billion rows": entry("gaussians.means", shape=[1 << 39, 3]),
    "more rows than bytes": entry("gaussians.means", shape=[400_000_000, 3]),
    "rows below 0": entry("gaussians.means", shape=[-1, 3]),
    "rows that are no number": entry("gaussians.means", shape=["3", 3]),
    "scales without end": entry("gaussians.scales", error="inf"),
    "no shape": entry("gaussians.means", shape=None),
    "another count": entry("gaussians.quats", shape=[299, 4]),
    "an unknown coding": entry("gaussians.means", coding="pickle"),
    "an unknown type": entry("gaussians.labels", dtype="object"),
    "wider numbers": entry("gaussians.quats", width=2),
    "a width of words": entry("gaussians.quats", width="1"),
    "a step of 0": entry("gaussians.means", step=0),
    "a step that is huge": entry("gaussians.means", step=1e39),
    "a step in words": entry("gaussians.means", step="wide"),
    "an origin of two": entry("gaussians.means", origin=[0, 0]),
    "an origin out of reach": entry("gaussians.means", origin=[1e300, 0, 0]),
    "means that need the means": entry("gaussians.means", coding="near"),
    "another checksum": entry("gaussians.means", crc32=0),
    "a missing tensor": lambda words: words["tensors"].pop("gaussians.means"),
    "a tensor too many": lambda words: words["tensors"].update(extra=words["tensors"]["seen.pixels"]),
    "no tensors": lambda words: words.update(tensors=[]),
    "cameras without names": lambda words: words.update(cameras=[[1, 2]]),
    "cameras of no size": lambda words: words.update(cameras=[["a", 0, 3, 0.2], ["b", 3, 3, 0.2]]),
    "one camera too few": lambda words: words["cameras"].pop(),
    "info that is no dictionary": lambda words: words.update(info=[1]),
    "no info": lambda words: words.pop("info"),
    "classes of other names": lambda words: words["words"].update(names=["one"]),
    "classes that are numbers": lambda words: words["words"].update(names=[1, 2]),
    "NaN": lambda words: words.update(info={"loss": float("nan")}),
    "more words than a description may have": lambda words: words.update(info={"a": "b" * container.WORDS}),
}


def test_pixels_of_other_gaussians_are_refused():
    tensors, description = store._to_tensors(vars(field(n=40)))
    tensors["seen.pixels"] = torch.ones(39)
    with pytest.raises(ValueError, match=tells("data:", "seen.pixels", "39")):
        unpack_field(container.pack_tensors(tensors, description, "lossless"))


def test_a_basis_whose_decomposition_takes_too_long_is_neither_rounded_nor_read(monkeypatch):
    made = field()  # 24 channels, 5 latents: 600
    rounded = pack_field(made)
    for module in (coding, container):
        monkeypatch.setattr(module, "QR_MOST", 599)
    assert torch.equal(unpack_field(pack_field(made)).linear.basis, made.linear.basis)
    with pytest.raises(ValueError, match=tells("data:", "quickly", "(24, 5)")):
        unpack_field(rounded)


def test_infinity_in_json_is_refused():
    data = remade(pack_field(field()), lambda words: None, replaced=('"nested"', '"loss": 1e999, "nested"'))
    with pytest.raises(ValueError, match=tells("data:", "finite", "1e999")):
        unpack_field(data)


@pytest.mark.parametrize("what", HOSTILE)
def test_a_description_that_lies_is_refused_by_the_name_of_its_file(tmp_path, what):
    path = tmp_path / f"stranger{ENDING}"
    path.write_bytes(remade(pack_field(field()), HOSTILE[what]))
    with pytest.raises(ValueError, match=tells(f"stranger{ENDING}:", "expected")):
        SemanticField.load(path)


def test_deep_json_and_streams_that_promise_too_much_are_refused():
    data = pack_field(field())
    streams = safetensors.torch.load(data)
    about = {"kfgs": json.dumps({"kind": "semantic field", "version": 1, "precision": "small", "gaussians": 300})}

    def with_stream(name, content):
        return safetensors.torch.save({**streams, name: torch.frombuffer(bytearray(content), dtype=torch.uint8)}, about)

    for text in (b"[" * 100_000, b'{"a":' * 50_000, b"[]", b"null", b"", b"\xff\xfe"):
        with pytest.raises(ValueError, match=tells("data:", "damaged")):
            unpack_field(with_stream("description", zstandard.compress(text)))
    bomb = zstandard.compress(bytes(1 << 28))  # 8 kB
    for name in ("description", "gaussians.means"):
        with pytest.raises(ValueError, match=tells("data:", "268435456 bytes")):
            unpack_field(with_stream(name, bomb))
    with pytest.raises(ValueError, match=tells("data:", "stream of bytes")):
        unpack_field(safetensors.torch.save({**streams, "gaussians.means": torch.zeros(3, 3)}, about))


def test_other_files_and_other_versions_are_named(tmp_path):
    path = tmp_path / f"a{ENDING}"
    for content in (
        b"",
        b"nonsense",
        struct.pack("<Q", 1 << 62) + b"{}",
        safetensors.torch.save({"a": torch.zeros(2)}),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=tells(path.name, "one file", "something else")):
            SemanticField.load(path)
    path.write_bytes(remade(pack_field(field()), lambda about: about.update(version=2), "kfgs"))
    with pytest.raises(ValueError, match=tells(path.name, "version 1", "got 2", "kfgs that wrote it")):
        SemanticField.load(path)
    with pytest.raises(FileNotFoundError, match=tells("none", "field.json")):
        SemanticField.load(tmp_path / "none")


@pytest.mark.parametrize("precision", ["lossless", "small"])
@pytest.mark.parametrize("method", ["fused", "adc+sc"])
def test_damaged_bytes_give_a_field_or_a_value_error(method, precision):
    data = pack_field(field(method, n=40), precision)
    random, read, said = np.random.default_rng(5), 0, []
    header = 8 + struct.unpack("<Q", data[:8])[0]
    for trial in range(150):
        damaged = bytearray(data)
        reach = header if trial % 2 else len(data)  # half of them in the header
        for _ in range(int(random.integers(1, 4))):
            damaged[int(random.integers(reach))] = int(random.integers(256))
        if trial % 10 == 0:
            damaged = damaged[: int(random.integers(len(data)))]
        if trial % 10 == 1:
            damaged += bytes(int(random.integers(1, 9)))
        try:
            found = unpack_field(bytes(damaged))
        except ValueError as error:
            said.append(str(error))
        else:
            read += 1
            assert len(found) == 40
            assert torch.isfinite(found.gaussians.means).all()
    assert all(message.startswith("data: expected") for message in said)
    assert read < 75  # checksums find what is damaged in the streams
