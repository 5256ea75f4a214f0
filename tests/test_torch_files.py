"""Files that attack whoever opens them, and files that name classes: nothing is run, each ends in one line or is read."""

import argparse
import collections
import enum
import functools
import operator
import os
import pickle
import re
import signal
import struct
import sys
import tracemalloc
import urllib.parse
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from pickled import CONTAINERS, Call, archive, legacy, pickled, tensor, text, zip_of

from kfgs._torch_files import Placeholder, TorchFileError, load_torch_file, pickle_check

GETATTR = b"cbuiltins\ngetattr\n"
PARTIAL = b"cfunctools\npartial\n(cbuiltins\nlen\ntR"


def attacks(marker: Path) -> dict[str, tuple[bytes, str | None]]:
    """Pickles that make `marker` when they run, and what the message names; None: read, with placeholders."""
    command = f"touch {marker}"
    shown = f"__import__('os').system({command!r})"
    x, mkdir = text(command), text(str(marker))
    os_of_torch = GETATTR + b"(ctorch\nserialization\n" + text("os") + b"tR"
    return {
        "os.system": (pickle.dumps(Call(os.system, command), 2), "posix.system"),
        "os.system as os": (b"cos\nsystem\n(" + x + b"tR.", "os.system"),
        "newobj": (b"\x80\x02cos\nsystem\n(" + x + b"t\x81.", "os.system"),
        "eval": (pickle.dumps(Call(eval, shown), 2), "builtins.eval"),
        "exec": (pickle.dumps(Call(exec, shown), 2), "builtins.e"),
        "getattr chain": (
            GETATTR + b"(cbuiltins\n__import__\n(" + text("os") + b"tR" + text("system") + b"tR(" + x + b"tR.",
            "builtins.__import__",
        ),
        "getattr of a module": (GETATTR + b"(" + os_of_torch + text("system") + b"tR(" + x + b"tR.", None),
        "mkdir of a module": (GETATTR + b"(" + os_of_torch + text("mkdir") + b"tR(" + mkdir + b"tR.", None),
        "nested in an allowed call": (
            pickle.dumps(Call(collections.OrderedDict, [["a", Call(os.system, command)]]), 2),
            "posix.system",
        ),
        "setstate": (
            pickle.dumps(Call(collections.OrderedDict, state={"x": Call(os.system, command)}), 2),
            "posix.system",
        ),
        "partial with the state of another": (
            PARTIAL
            + b"("
            + GETATTR
            + b"(ctorch.serialization\nos\nt}Nt"
            + b"b("
            + text("mkdir")
            + b"tR("
            + mkdir
            + b"tR.",
            None,
        ),
        "spawn": (
            b"cdistutils.spawn\nspawn\n(]" + text("touch") + b"a" + mkdir + b"atR.",
            None,
        ),
        "runpy": (b"crunpy\n_run_code\n(" + text(shown) + b"}tR.", "runpy._run_code"),
        "inst": (b"(" + x + b"ios\nsystem\n.", "INST of protocol 0"),
        "obj": (b"(cos\nsystem\n" + x + b"o.", "os.system"),
        "dotted": (b"\x80\x04\x8c\x05torch\x8c\x17serialization.os.system\x93" + x + b"\x85R.", "protocol 4"),
        "global dotted": (b"ctorch\nserialization.os.system\n" + x + b"\x85R.", None),
        "copyreg": (
            b"\x80\x02ccopy_reg\n_reconstructor\n(cposix\nsystem\nc__builtin__\nobject\nNtR(" + x + b"t\x81.",
            "posix.system",
        ),
        "named but never called": (b"\x80\x02csubprocess\nPopen\n.", "subprocess.Popen"),
        "loads another pickle": (
            b"cpickle\nloads\n(c_codecs\nencode\n(" + x + text("latin1") + b"tRtR.",
            "pickle.loads",
        ),
        "torch.load": (b"ctorch\nload\n(" + x + b"tR.", None),
        "torch.hub": (b"ctorch.hub\nload\n(" + x + b"tR.", None),
        "numpy": (b"cnumpy\nload\n(" + x + b"tR.", None),
        "attrgetter": (b"coperator\nattrgetter\n(" + text("a") + b"tR(ctorch\nx\ntR.", None),
        "getattr in a list": (b"]" + GETATTR + b"a.", None),
        "getattr as an argument": (b"cfunctools\nreduce\n(" + GETATTR + b"]" + text("os") + b"actorch\nx\ntR.", None),
        "class as a callback": (
            b"ctorch._tensor\n_rebuild_from_type_v2\n(cposixpath\nisdir\n)N}tR.",
            "_rebuild_from_type",
        ),
        "line end in a name": (b"ctorch serialization\nos\n)R.", "name"),
    }


ATTACKS = attacks(Path("x"))


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("attack", ATTACKS)
def test_an_attack_runs_nothing_and_imports_nothing(tmp_path: Path, attack: str, container: str) -> None:
    marker, path, honest = tmp_path / "ran", tmp_path / "weights.ckpt", tmp_path / "honest.pt"
    honest.write_bytes(archive(pickled({"a": tensor(size=(1,))}), bytes(16)))
    body, named = attacks(marker)[attack]
    path.write_bytes(CONTAINERS[container](body))
    load_torch_file(honest)  # torch imports some modules when it reads the first file
    modules = set(sys.modules)
    if container == "pickle":
        with pytest.raises(TorchFileError, match="torch.save|text"):
            load_torch_file(path)
    elif named is None:
        found = load_torch_file(path)
        if container == "lightning":
            assert found.pop("state_dict")["a"].tolist() == [1, 1]
    else:
        with pytest.raises(TorchFileError, match=tells(named)) as caught:
            load_torch_file(path)
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 300
        if "." in named:
            assert "nothing was run; do not trust this file" in str(caught.value)
    assert not marker.exists()
    assert set(sys.modules) == modules


def test_the_attacks_do_run_elsewhere(tmp_path: Path) -> None:
    """So that the test above cannot pass because its pickles are broken."""
    marker, ran = tmp_path / "ran", set()
    for name, (body, _) in attacks(marker).items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                pickle.loads(body)
        except Exception:
            continue
        if marker.exists():
            ran.add(name)
            marker.rmdir() if marker.is_dir() else marker.unlink()
    assert ran == {
        *("os.system", "os.system as os", "eval", "exec", "getattr chain", "getattr of a module", "mkdir of a module"),
        *("nested in an allowed call", "setstate", "partial with the state of another", "inst", "obj", "dotted"),
        *("runpy", "spawn"),
    }


def test_classes_that_another_library_has_allowed_are_not_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"settings": Evil()}, tmp_path / "a.pt")
    with torch.serialization.safe_globals([Evil]):
        assert load_torch_file(tmp_path / "a.pt") == {"settings": {"k": 2}}
        assert Evil in torch.serialization.get_safe_globals()
    assert not (tmp_path / "ran").exists()
    torch.load(tmp_path / "a.pt", weights_only=False)
    assert (tmp_path / "ran").exists()  # it would have


class Evil(dict):
    """Does everything that a pickle can do to an object besides calling a function; each would make a file."""

    def __init__(self, marker: str = "") -> None:
        super().__init__()
        if marker:
            Path(marker).touch()

    def __reduce__(self):
        return Evil, ("ran",), {"a": 1}, None, iter([("k", 2)])

    def __setstate__(self, state) -> None:
        Path("ran").touch()

    def __setitem__(self, key, value) -> None:
        Path("ran").touch()


# --- settings of honest files -------------------------------------------------------------------------------------------


class Outer:
    class Inner:
        class Deep:
            pass

    class Kind(enum.Enum):
        A = 1

    def method(self) -> None:
        pass


class Keywords:
    """Is made by a call of `partial(cls.__new__, cls, a=2)` before protocol 4."""

    def __new__(cls, *, a: int = 1) -> "Keywords":
        return object.__new__(cls)

    def __getnewargs_ex__(self) -> tuple[tuple[()], dict[str, int]]:
        return (), {"a": 2}


class Slots:
    __slots__ = ("a",)

    def __init__(self) -> None:
        self.a = 1


class Config(dict):  # as of yacs, addict, easydict
    def __init__(self) -> None:
        super().__init__(lr=1, inner={"a": 2})
        self.frozen = True


class Items(list):
    pass


OPTIMIZER = torch.optim.Adam([torch.nn.Parameter(torch.ones(2))])
HONEST = {
    "nested class": Outer.Inner,
    "class in it": Outer.Inner.Deep,
    "its instance": Outer.Inner(),
    "method": Outer().method,
    "method of a type": str.upper,
    "item": operator.itemgetter(1),
    "attribute": operator.attrgetter("lr.value"),
    "partial": functools.partial(print, 1),
    "alias": list[int],
    "union": int | str,
    "scalar": np.float32(2),
    "array": np.ones(3),
    "generator": np.random.default_rng(0),
    "random state": np.random.RandomState(0),
    "namespace": argparse.Namespace(lr=1),
    "slots": Slots(),
    "signal": signal.SIGTERM,
    "regular expression": re.compile("a"),
    "path": Path("a/b"),
    "enumeration inside": Outer.Kind.A,
    "shared tuple": [(0.9, 0.999)] * 3,
    "set of tuples": {(1, 2), (3, "a")},
    "many times the same": [[0.5] * 3] * 1000,
    "keywords": Keywords(),
    "scheduler": torch.optim.lr_scheduler.MultiStepLR(OPTIMIZER, [3, 5]).state_dict(),
    "Python 2's names": [KeyError("a"), urllib.parse.urlsplit("https://a/b")],
    "optimizer": OPTIMIZER.state_dict(),
}


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("kind", HONEST)
def test_settings_are_read_with_placeholders(tmp_path: Path, kind: str, zipped: bool) -> None:
    value = {"a": torch.ones(2), "settings": argparse.Namespace(x=HONEST[kind]), "s": HONEST[kind]}
    torch.save(value, tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
    found = load_torch_file(tmp_path / "a.pt")
    assert found["a"].tolist() == [1, 1]
    assert isinstance(found["settings"], Placeholder)
    assert found["settings"].__name__ == "argparse.Namespace"


@pytest.mark.parametrize("container", [archive, legacy])
def test_attributes_of_dicts_and_tensors_do_not_replace_their_methods(tmp_path: Path, container) -> None:
    methods = dict.fromkeys(("values", "items", "get", "numel", "detach", "untyped_storage", "element_size"), Outer)
    parameter = Call(torch._utils._rebuild_parameter_with_state, tensor(legacy=container is legacy), True, {}, methods)
    state = Call(collections.OrderedDict, state=methods)
    body = pickled([state, parameter])
    (tmp_path / "a.pt").write_bytes(container(body, np.arange(4, dtype=np.float32).tobytes()))
    empty, found = load_torch_file(tmp_path / "a.pt")
    assert list(empty.values()) == []
    assert found.detach().tolist() == [0, 1, 2, 3]


def test_what_is_like_a_dict_or_a_list_is_one(tmp_path: Path) -> None:
    items = Items([1, 2])
    torch.save({"config": Config(), "items": items, "d": collections.defaultdict(list, a=[3])}, tmp_path / "a.pt")
    found = load_torch_file(tmp_path / "a.pt")
    assert found == {"config": {"lr": 1, "inner": {"a": 2}}, "items": [1, 2], "d": {"a": [3]}}


# --- too much work ------------------------------------------------------------------------------------------------------

CALL_ENCODE = b"c_codecs\nencode\n"
ORDERED = b"ccollections\nOrderedDict\n"
PAIRS = b"".join(text(f"{i:05}") + b"N\x86" for i in range(20_000))
A_TENSOR = pickled(tensor())[:-1]
BOMBS = {
    "a key that takes 2^64 steps to hash": b"})q\x00" + b"h\x00\x86q\x00" * 64 + b"K\x01s.",
    "the same in a set": b"c__builtin__\nset\n])q\x00" + b"h\x00\x86q\x00" * 64 + b"a\x85R.",
    "a key so deep that its hash overflows the stack": b"})" + b"\x85" * 200_000 + b"K\x01s.",
    "a deep tuple of marks": b"(" * 200_000 + b"t" * 200_000 + b".",
    "set of a tensor": b"c__builtin__\nset\n" + A_TENSOR + b"\x85R.",
    "OrderedDict of a tensor": ORDERED + A_TENSOR + b"\x85R.",
    "a tensor as arguments": b"ca\nB\n" + A_TENSOR + b"R.",
    "a tensor as a state": ORDERED + b")R" + A_TENSOR + b"b.",
    "one list copied again and again": b"]("
    + PAIRS
    + b"eq\x00"
    + b"]("
    + (ORDERED + b"h\x00\x85R") * 20_000
    + b"e\x86.",
    "one text copied again and again": text("a" * 100_000)
    + b"q\x00]("
    + (CALL_ENCODE + b"h\x00" + text("latin1") + b"\x86R") * 10_000
    + b"e\x86.",
    "one list of arguments again and again": b"(" + b"N" * 60_000 + b"tq\x00](" + b"ca\nB\nh\x00R" * 10_000 + b"e\x86.",
    "a terabyte of zeros": b"c__builtin__\nbytearray\n\x8a\x06" + (1 << 40).to_bytes(6, "little") + b"\x85R.",
    "bytes doubled again and again": CALL_ENCODE * 40 + text("ab") + (text("hex") + b"\x86R") * 40 + b".",
    "a codec that takes ever longer": CALL_ENCODE + text("ü" * 50_000) + text("punycode") + b"\x86R.",
    "an expanded tensor converted": b"ctorch._utils\n_rebuild_device_tensor_from_cpu_tensor\n("
    + pickled(tensor(size=(1 << 40,), stride=(0,)))[:-1]
    + b"ctorch\nfloat64\n"
    + text("cpu")
    + b"\x89tR.",
    "many classes": b"".join(b"ca\nB%d\n" % i for i in range(600)) + b".",
    "a terabyte of bytes": b"\x80\x04\x8e" + (1 << 40).to_bytes(8, "little") + b"x.",
    "a text longer than the file": b"\x80\x02X\xff\xff\xff\x7fabc.",
}


@pytest.mark.parametrize("container", [archive, legacy])
@pytest.mark.parametrize("bomb", BOMBS)
def test_a_bomb_is_refused_before_it_does_much(tmp_path: Path, bomb: str, container) -> None:
    (tmp_path / "a.pt").write_bytes(container(BOMBS[bomb], bytes(16)))
    tracemalloc.start()
    try:
        with pytest.raises(TorchFileError) as caught:
            load_torch_file(tmp_path / "a.pt")
        assert tracemalloc.get_traced_memory()[1] < 200 << 20
    finally:
        tracemalloc.stop()
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("container", [archive, legacy])
def test_a_place_in_the_memo_far_away_takes_no_memory(tmp_path: Path, container) -> None:
    (tmp_path / "a.pt").write_bytes(container(b"\x80\x02K\x01r\xff\xff\xff\xff."))  # 32 GB in C's unpickler
    assert load_torch_file(tmp_path / "a.pt") == 1


def test_too_many_opcodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.pt").write_bytes(archive(b"(" * 20 + b"N."))
    assert load_torch_file(tmp_path / "a.pt") is None
    monkeypatch.setattr(pickle_check.check_pickle, "__defaults__", (10,))
    with pytest.raises(TorchFileError, match=tells("10 opcodes")):
        load_torch_file(tmp_path / "a.pt")


def test_a_checkpoint_of_many_tensors_is_within_the_limits(tmp_path: Path) -> None:
    """With optimiser states that share their keys and settings; also twice in one file."""
    betas = (0.9, 0.999)
    state = {f"encoder.blocks.{i}.attention.query_key_value.weight": torch.ones(1) for i in range(5000)}
    groups = [{"betas": betas, "lr": 0.1, "params": [i]} for i in range(5000)]
    torch.save({"model": state, "ema": state, "groups": groups}, tmp_path / "a.pt")
    found = load_torch_file(tmp_path / "a.pt")
    assert len(found["ema"]) == 5000
    assert found["groups"] == groups


# --- damaged and odd files ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("container", [archive, legacy])
@pytest.mark.parametrize(
    "arguments",
    [
        {"size": (8,), "numel": 8},
        {"size": (5,)},
        {"offset": 1},
        {"size": (2,), "stride": (9,)},
        {"offset": -1, "size": (2,)},
        {"size": (-2,)},
        {"stride": (-1,)},
        {"size": (2.5,)},
        {"size": (10**23,)},
        {"size": (2, 2)},
        {"numel": -4},
        {"numel": 10**30},
        {"numel": 2.5},
        {"numel": "4"},
        {"size": None},
    ],
)
def test_a_tensor_that_does_not_fit_its_storage_is_refused(tmp_path: Path, arguments: dict, container) -> None:
    body = pickled({"a": tensor(**arguments, legacy=container is legacy)})
    (tmp_path / "a.pt").write_bytes(container(body, np.arange(4, dtype=np.float32).tobytes()))
    with pytest.raises(TorchFileError) as caught:
        load_torch_file(tmp_path / "a.pt")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("device", [b"ctorch\n", b"ctorch.cuda\n"])  # old files name the device's storage
@pytest.mark.parametrize("container", [archive, legacy])
def test_the_same_with_right_arguments_is_read(tmp_path: Path, container, device: bytes) -> None:
    body = pickled(tensor(1, (2,), (2,), legacy=container is legacy)).replace(b"ctorch\n", device)
    (tmp_path / "a.pt").write_bytes(container(body, np.arange(4, dtype=np.float32).tobytes()))
    assert load_torch_file(tmp_path / "a.pt").tolist() == [1, 3]


def test_storages_that_are_not_aligned_are_read_and_shared(tmp_path: Path) -> None:
    """As in an archive that was unpacked and packed again."""
    values = np.arange(1000, dtype=np.float32).tobytes()
    body = pickled([tensor(i, (1,)).parts and tensor(i, (1,), numel=1000) for i in range(300)])
    for padding in range(1, 5):
        records = {"x/data.pkl": body, "x/version": b"3\n", "x/" + "y" * padding: b"", "x/data/0": values}
        (tmp_path / "a.pt").write_bytes(zip_of(records))
        with zipfile.ZipFile(tmp_path / "a.pt") as file:
            first = file.getinfo("x/data/0").header_offset + 30 + len("x/data/0")
        if first % 4:
            break
    assert first % 4
    found = load_torch_file(tmp_path / "a.pt")
    assert [int(one) for one in found] == list(range(300))
    assert len({one.untyped_storage().data_ptr() for one in found}) == 1


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("zipped", [True, False])
def test_newer_protocols_are_refused_with_a_way_to_convert(tmp_path: Path, protocol: int, zipped: bool) -> None:
    state = {"a": torch.ones(2)}
    torch.save(state, tmp_path / "a.pt", pickle_protocol=protocol, _use_new_zipfile_serialization=zipped)
    with pytest.raises(TorchFileError, match=tells("protocol 4", "save it again", "default pickle_protocol")):
        load_torch_file(tmp_path / "a.pt")


def test_a_zip_archive_of_torch_must_not_be_named_safetensors(tmp_path: Path) -> None:
    torch.save({"a": torch.ones(2)}, tmp_path / "a.safetensors")
    with pytest.raises(TorchFileError, match=tells("rename")):
        load_torch_file(tmp_path / "a.safetensors")


def _in_other_case(good: dict[str, bytes], evil: bytes) -> bytes:
    """torch's reader takes x/DATA.PKL for x/data.pkl."""
    return zip_of(good | {"x/DATA.PKL": evil})


def _with_two_directories(good: dict[str, bytes], evil: bytes) -> bytes:
    """An archive whose end points to the directory of another one before it, which zipfile takes for other bytes."""

    def parts(records: dict[str, bytes]) -> tuple[bytes, bytes, bytes]:
        data = zip_of(records)
        end = data.rindex(b"PK\5\6")
        start = struct.unpack_from("<L", data, end + 16)[0]
        return data[:start], data[start:end], data[end:]

    evil_body, evil_directory, end = parts(good | {"x/data.pkl": evil})
    body, directory, _ = parts(good)
    assert len(directory) == len(evil_directory)
    moved, place = bytearray(directory), 0
    while place < len(moved):
        lengths = struct.unpack_from("<3H", moved, place + 28)
        (offset,) = struct.unpack_from("<L", moved, place + 42)
        struct.pack_into("<L", moved, place + 42, offset - len(body) + len(evil_body))
        place += 46 + sum(lengths)
    return evil_body + evil_directory + body + bytes(moved) + end


@pytest.mark.parametrize("container", [_in_other_case, _with_two_directories])
def test_torch_reads_the_pickle_that_was_checked(tmp_path: Path, container) -> None:
    """Python's zipfile and torch's reader must not find different pickles in one archive."""
    good, evil = pickled({"weights": 1}), pickled({"a longer name": 2})
    data = container({"x/data.pkl": good, "x/version": b"3\n"}, evil)
    (tmp_path / "a.pt").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "a.pt") as seen:
        assert seen.read("x/data.pkl") == good
    assert torch._C.PyTorchFileReader(str(tmp_path / "a.pt")).get_record("data.pkl") == evil
    with pytest.raises(TorchFileError, match=tells("two readers")):
        load_torch_file(tmp_path / "a.pt")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"](" + b"K\x01" * 2_500_000 + b"e", "600,000 opcodes"),
        (b"Nq\x00](" + b"h\x00" * 2_500_000 + b"e", "600,000 opcodes"),
        (b"(" * 5_000_000, "nests more than 1000 deep"),
    ],
    ids=["numbers", "copies", "marks"],
)
def test_a_pickle_of_5_mb_that_takes_long_is_refused(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "a.pt"
    path.write_bytes(archive(b"\x80\x02" + content + b"."))
    with pytest.raises(TorchFileError, match=tells(told)):
        load_torch_file(path)


def test_the_facts_before_an_old_file_are_short(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.pt", legacy(pickled({"a": 1}))
    path.write_bytes(whole)
    assert load_torch_file(path) == {"a": 1}
    magic = whole.index(b".") + 1
    path.write_bytes(whole[:magic] + b"\x80\x02](" + b"K\x01" * 2_000 + b"e." + whole[magic:])
    with pytest.raises(TorchFileError, match=tells("1,000 opcodes")):
        load_torch_file(path)
