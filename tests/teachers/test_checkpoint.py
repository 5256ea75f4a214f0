import argparse
import collections
import io
import os
import pickle
import pickletools
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kfgs._files import digest_file
from kfgs.teachers import checkpoint
from kfgs.teachers.checkpoint import read_checkpoint, weights_digest

DTYPES = [
    torch.float32,
    torch.float16,
    torch.bfloat16,
    torch.float64,
    torch.int64,
    torch.uint8,
    torch.bool,
    torch.complex64,
]


def make_state() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    state: dict[str, torch.Tensor] = collections.OrderedDict()
    for index, dtype in enumerate(DTYPES):
        state[f"net.{index}.weight"] = (torch.rand(3, 5, generator=generator) * 9).to(dtype)
    base = torch.rand(4, 6, generator=generator)
    state["net.transposed"], state["net.sliced"], state["net.tied"] = base.T, base[1:3, 2:], base
    state["net.scalar"], state["net.empty"] = torch.tensor(2.5), torch.zeros(0, 7)
    state["net.parameter"] = torch.nn.Parameter(torch.rand(2, 2, generator=generator))
    return state


def assert_same(found: dict[str, torch.Tensor], state: dict[str, torch.Tensor]) -> None:
    assert list(found) == list(state)
    for name, value in state.items():
        assert found[name].dtype == value.dtype, name
        assert found[name].device.type == "cpu"
        assert not found[name].requires_grad
        assert torch.equal(found[name], value.detach()), name


class Callback:  # stands for the classes that Lightning's files name
    pass


WRAPPED = {
    "plain": lambda state: state,
    "lightning": lambda state: {
        "epoch": 200,
        "pytorch-lightning_version": "1.4.9",
        "callbacks": {Callback: {"best_model_score": torch.tensor(0.5), "best_model_path": Path("a/b.ckpt")}},
        "optimizer_states": [{"state": {0: {"step": np.float64(3), "exp_avg": torch.ones(4)}}}],
        "hyper_parameters": argparse.Namespace(
            backbone="clip_vitl16_384", scales=[0.5, 1], seen={1, (2, 3)}, big=10**30
        ),
        "state_dict": state,
    },
    "model": lambda state: {"model": state, "epoch": 3},
    "model_state_dict": lambda state: {"optimizer": {}, "model_state_dict": state},
    "nested": lambda state: {"model": {"state_dict": state}},
    "extras": lambda state: collections.defaultdict(list, **state, version=3, note="x"),
}


@pytest.mark.parametrize("wrap", WRAPPED.values(), ids=WRAPPED.keys())
@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_reads_what_torch_saves(tmp_path: Path, wrap, zipped: bool) -> None:
    state = make_state()
    torch.save(wrap(state), tmp_path / "a.ckpt", _use_new_zipfile_serialization=zipped)
    assert_same(read_checkpoint(tmp_path / "a.ckpt"), state)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_reads_every_protocol(tmp_path: Path, protocol: int) -> None:
    torch.save(make_state(), tmp_path / "a.pt", pickle_protocol=protocol)
    assert_same(read_checkpoint(tmp_path / "a.pt"), make_state())


def test_reads_safetensors_by_content(tmp_path: Path) -> None:
    state = {name: torch.rand(3, 4) for name in "ab"}
    save_file(state, tmp_path / "a.ckpt")
    assert_same(read_checkpoint(tmp_path / "a.ckpt"), state)


def test_writing_to_a_tensor_leaves_the_file_and_the_others_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"a": torch.ones(4), "b": torch.ones(4)}, path)
    before = digest_file(path)
    found = read_checkpoint(path)
    found["a"].zero_()
    assert found["b"].tolist() == [1, 1, 1, 1]
    assert digest_file(path) == before == weights_digest(path)
    assert found["a"].untyped_storage().nbytes() == 16  # saving it again writes these, not the whole file


def test_tied_tensors_share_memory(tmp_path: Path) -> None:
    weight = torch.ones(4)
    torch.save({"a": weight, "b": weight}, tmp_path / "a.pt")
    found = read_checkpoint(tmp_path / "a.pt")
    assert found["a"].data_ptr() == found["b"].data_ptr()


def test_reading_does_not_touch_the_values(tmp_path: Path) -> None:
    """64 MiB of weights are mapped: the process's own memory grows by less than a sixteenth of that."""
    torch.save({"a": torch.zeros(1 << 24)}, tmp_path / "a.pt")
    resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")  # noqa: E731
    before = resident()
    found = read_checkpoint(tmp_path / "a.pt")
    assert resident() - before < 4 << 20
    assert found["a"].shape == (1 << 24,)


# --- hostile pickles ----------------------------------------------------------------------------------------------------


class Call:
    """Pickles as a call of `function`, which is named by the pickle alone."""

    def __init__(self, function, *arguments, state=None) -> None:
        self.parts = (function, arguments, state) if state is not None else (function, arguments)

    def __reduce__(self):
        return self.parts


def touch(marker: Path) -> str:
    return f"touch {marker}"


def attacks(marker: Path) -> dict[str, tuple[bytes, str]]:
    """Pickles that write `marker` when they run, and the global that must be named."""
    command = touch(marker)
    shown = f"__import__('os').system({command!r})"
    text = command.encode()
    return {
        "os.system": (pickle.dumps(Call(os.system, command)), "posix.system"),
        "os.system as os": (b"cos\nsystem\n(S'" + text + b"'\ntR.", "os.system"),
        "inst": (b"(S'" + text + b"'\nios\nsystem\n.", "os.system"),
        "obj": (b"(cos\nsystem\nS'" + text + b"'\no.", "os.system"),
        "newobj": (b"\x80\x02cos\nsystem\n(S'" + text + b"'\nt\x81.", "os.system"),
        "eval": (pickle.dumps(Call(eval, shown)), "builtins.eval"),
        "exec": (pickle.dumps(Call(exec, shown), 2), "__builtin__.eval|__builtin__.exec|builtins.exec"),
        "getattr chain": (
            b"cbuiltins\ngetattr\n(cbuiltins\n__import__\n(S'os'\ntRS'system'\ntR(S'" + text + b"'\ntR.",
            "builtins.__import__",
        ),
        "getattr of a module": (
            b"cbuiltins\ngetattr\n(cbuiltins\ngetattr\n(ctorch\nserialization\nS'os'\ntRS'system'\ntR(S'"
            + text
            + b"'\ntR.",
            "torch.serialization.os",
        ),
        "nested in an allowed call": (
            pickle.dumps(Call(collections.OrderedDict, [["a", Call(os.system, command)]])),
            "posix.system",
        ),
        "dotted through torch": (
            b"\x80\x04\x8c\x0ctorch.serial\x8c\x09os.system\x93\x8c\x01x\x85R.",
            r"torch.serial.os.system",
        ),
        "setstate": (
            pickle.dumps(Call(collections.OrderedDict, state={"x": Call(os.system, command)})),
            "posix.system",
        ),
        "copyreg": (
            b"\x80\x02ccopy_reg\n_reconstructor\n(cposix\nsystem\nc__builtin__\nobject\nNtR(S'" + text + b"'\nt\x81.",
            "posix.system",
        ),
        "named but never called": (b"\x80\x02csubprocess\nPopen\n0N.", "subprocess.Popen"),
        "extension, then call": (b"\x80\x02cbuiltins\n__import__\n(S'os'\ntR.", "builtins.__import__"),
        "runpy": (b"\x80\x02crunpy\n_run_code\n(S'x'\ntR.", "runpy._run_code"),
    }


ATTACKS = list(attacks(Path("x")))


@pytest.mark.parametrize("container", ["pickle", "zip", "legacy", "lightning"])
@pytest.mark.parametrize("attack", ATTACKS)
def test_malicious_pickle_runs_nothing_and_is_refused_by_name(tmp_path: Path, attack: str, container: str) -> None:
    marker, path = tmp_path / "ran", tmp_path / "weights.ckpt"
    body, name = attacks(marker)[attack]
    path.write_bytes(contained(body, container))
    with pytest.raises(ValueError, match=rf"asks to run ({name}).*nothing was run; do not trust this file") as caught:
        read_checkpoint(path)
    assert not marker.exists()
    assert "\n" not in str(caught.value)


def test_the_attacks_do_run_elsewhere(tmp_path: Path) -> None:
    """So that the test above cannot pass because its pickles are broken."""
    ran = 0
    for name, (body, _) in attacks(tmp_path / "ran").items():
        if name in (
            "os.system",
            "os.system as os",
            "inst",
            "obj",
            "eval",
            "nested in an allowed call",
            "setstate",
            "getattr chain",
            "getattr of a module",
        ):
            (tmp_path / "ran").unlink(missing_ok=True)
            pickle.loads(body)
            ran += (tmp_path / "ran").exists()
    assert ran == 9


def contained(body: bytes, container: str) -> bytes:
    """A pickle in the places where torch keeps one."""
    if container == "pickle":
        return body
    if container == "legacy":
        start = (
            pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2) + pickle.dumps({"little_endian": True}, 2)
        )
        return start + body + pickle.dumps([], 2)
    if container == "lightning":  # a good state dict before it: the whole file is refused all the same
        good = io.BytesIO()
        torch.save({"state_dict": {"a": torch.ones(2)}, "callbacks": None}, good)
        with zipfile.ZipFile(good) as archive:
            records = {info.filename: archive.read(info) for info in archive.infolist()}
        root = next(name for name in records if name.endswith("data.pkl"))
        pickled = records[root]
        assert pickled.endswith(b"u.")
        # a third key, whose value is the attack, set before the end
        records[root] = pickled[:-1] + b"X\x04\x00\x00\x00evil" + strip(body) + b"s."
        return zip_of(records)
    return zip_of({"archive/data.pkl": body, "archive/version": b"3\n"})


def strip(body: bytes) -> bytes:
    """A pickle without its protocol, frames and end, to be put into another."""
    spans = [(opcode.name, position) for opcode, _, position in pickletools.genops(body)]
    ends = [position for _, position in spans[1:]] + [len(body)]
    return b"".join(
        body[start:end]
        for (name, start), end in zip(spans, ends, strict=True)
        if name not in ("PROTO", "FRAME", "STOP", "MEMOIZE", "BINPUT")
    )


def zip_of(records: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", compression) as archive:
        for name, content in records.items():
            archive.writestr(name, content)
    return data.getvalue()


class Evil(dict):
    """Everything a pickle can do to an object besides calling a function; each would write a file."""

    marker = ""

    def __reduce__(self):
        return Evil, (self.marker,), {"a": 1}, iter([1]), iter([("k", 2)])

    def __new__(cls, marker: str = ""):
        if marker:
            Path(marker).touch()
        return super().__new__(cls)

    def __init__(self, marker: str = "") -> None:
        super().__init__()
        self.marker = marker

    def __setstate__(self, state) -> None:
        Path(self.marker).touch()

    def __setitem__(self, key, value) -> None:
        Path(self.marker).touch()

    def append(self, value) -> None:
        Path(self.marker).touch()

    def extend(self, values) -> None:
        Path(self.marker).touch()


def test_unknown_classes_are_inert(tmp_path: Path) -> None:
    evil = Evil()
    evil.marker = str(tmp_path / "ran")
    torch.save({"state_dict": {"a": torch.ones(2)}, "settings": evil}, tmp_path / "a.ckpt")
    assert not (tmp_path / "ran").exists()
    assert_same(read_checkpoint(tmp_path / "a.ckpt"), {"a": torch.ones(2)})
    assert not (tmp_path / "ran").exists()
    torch.load(tmp_path / "a.ckpt", weights_only=False)
    assert (tmp_path / "ran").exists()  # it would have


def rebuilt(storage: str, arguments: str) -> bytes:
    """A legacy pickle {"a": tensor} in protocol 0; both texts are opcodes."""
    call = f"ctorch._utils\n_rebuild_tensor_v2\n({storage}{arguments}tR"
    return f"(dS'a'\n{call}s.".encode()


FLOATS = "(S'storage'\nctorch\nFloatStorage\nS'0'\nS'cpu'\nI{}\ntQ"  # BINPERSID of the tuple


@pytest.mark.parametrize(
    ("arguments", "numel", "match"),
    [
        ("I0\n(I8\nt(I1\ntI00\n(d", 8, "does not fit into the 4 values"),
        ("I0\n(I5\nt(I1\ntI00\n(d", 4, "does not fit"),
        ("I1\n(I4\nt(I1\ntI00\n(d", 4, "does not fit"),
        ("I0\n(I2\nt(I9\ntI00\n(d", 4, "does not fit"),
        ("I0\n(L1000000000000L\nt(I0\ntI00\n(d", 4, "does not fit"),  # expanded: 4 TB from one value
        ("I0\n(I0\nL100000000000000L\nL100000000000000L\nt(I1\nI1\nI1\ntI00\n(d", 4, "impossible size"),
        ("I-1\n(I2\nt(I1\ntI00\n(d", 4, "sizes that are no whole numbers"),
        ("I0\n(I-2\nt(I1\ntI00\n(d", 4, "sizes that are no whole numbers"),
        ("I0\n(I2\nt(I-1\ntI00\n(d", 4, "sizes that are no whole numbers"),
        ("I0\n(F2.5\nt(I1\ntI00\n(d", 4, "sizes that are no whole numbers"),
        ("I0\n(L99999999999999999999999L\nt(I1\ntI00\n(d", 4, "sizes that are no whole numbers"),
        ("I0\n(I2\nI2\nt(I1\ntI00\n(d", 4, "2 sizes and 1 strides"),
        ("I0\n(" + "I1\n" * 65 + "t(" + "I1\n" * 65 + "tI00\n(d", 4, r"from 0 \(64 at most\)"),
        ("I0\n(I2\nt(I1\ntI00\n(d", -4, "storage of unknown type"),
        ("I0\n", 4, "cannot be read"),
    ],
)
@pytest.mark.parametrize("container", ["zip", "legacy"])
def test_hostile_tensors_are_refused(tmp_path: Path, arguments: str, numel: int, match: str, container: str) -> None:
    body = rebuilt(FLOATS.format(numel), arguments)
    values = np.arange(4, dtype=np.float32).tobytes()
    if container == "zip":
        data = zip_of({"x/data.pkl": body, "x/data/0": values})
    else:
        head = contained(body, "legacy")
        data = head.removesuffix(pickle.dumps([], 2)) + pickle.dumps(["0"], 2) + struct.pack("<q", 4) + values
    (tmp_path / "a.pt").write_bytes(data)
    with pytest.raises(ValueError, match=match):
        read_checkpoint(tmp_path / "a.pt")


@pytest.mark.parametrize("storage", [FLOATS, FLOATS.replace("ctorch", "ctorch.cuda")])  # old files name the device's
def test_the_same_pickle_with_right_arguments_is_read(tmp_path: Path, storage: str) -> None:
    body = rebuilt(storage.format(4), "I1\n(I2\nt(I2\ntI00\n(d")
    (tmp_path / "a.pt").write_bytes(zip_of({"x/data.pkl": body, "x/data/0": np.arange(4, dtype=np.float32).tobytes()}))
    assert read_checkpoint(tmp_path / "a.pt")["a"].tolist() == [1, 3]


@pytest.mark.parametrize(("numel", "expected"), [(2, [2, 3]), (3, None)])
def test_views_of_storages_as_torch_wrote_them_before_0_4(tmp_path: Path, numel: int, expected: list | None) -> None:
    """A storage of 4 values, and a view of it from its third value on: two fit, three do not."""
    view = f"(S'storage'\nctorch\nFloatStorage\nS'0'\nS'cpu'\nI4\n(S'v'\nI2\nI{numel}\nttQ"
    head = contained(rebuilt(view, f"I0\n(I{numel}\nt(I1\ntI00\n(d"), "legacy").removesuffix(pickle.dumps([], 2))
    values = struct.pack("<q4f", 4, 0, 1, 2, 3)
    (tmp_path / "a.pt").write_bytes(head + pickle.dumps(["0"], 2) + values)
    if expected is None:
        with pytest.raises(ValueError, match="does not fit into the 2 values of its storage"):
            read_checkpoint(tmp_path / "a.pt")
    else:
        assert read_checkpoint(tmp_path / "a.pt")["a"].tolist() == expected


@pytest.mark.parametrize(
    "body",
    [
        b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"x.",  # 1 TB of bytes
        b"\x80\x02X\xff\xff\xff\x7fabc.",
        b"\x80\x02K\x01r\xff\xff\xff\xff.",  # memo 2^32 - 1: a good pickle of 1, and a C unpickler's 32 GB
        b"\x80\x02" + b"(" * 200_000 + b"t" * 200_000 + b"}.",
        b"\x80\x02)" + b"\x85" * 200_000 + b"2\x85.",
        b"\x80\x02}" + b")" + b"\x85" * 200_000 + b"K\x01s.",  # a deep key, whose hash overflows C's stack
        b"\x80\x02\x8f(" + b")" + b"\x85" * 200_000 + b"\x90.",  # the same into a set
        b"\x80\x02R.",
        b"\x80\x02.",
        b"\x80\x02h\x05.",
        b"\x80\x02K\x01K\x02\x93.",
        b"\x80\x02\x97.",  # NEXT_BUFFER
        b"\x80\x02}",
    ],
)
def test_hostile_bytes_end_in_one_line(tmp_path: Path, body: bytes) -> None:
    (tmp_path / "a.pt").write_bytes(zip_of({"x/data.pkl": body}))
    with pytest.raises(ValueError, match=r"expected a checkpoint .*, got .*; download it again") as caught:
        read_checkpoint(tmp_path / "a.pt")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_every_truncation_and_many_flips_give_one_line(tmp_path: Path) -> None:
    """Cut anywhere, the file is refused; with one byte changed it is read or refused, never anything else."""
    generator = np.random.default_rng(0)
    state = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2)}
    for zipped in (True, False):
        buffer = io.BytesIO()
        torch.save({"state_dict": state, "x": argparse.Namespace(a=1)}, buffer, _use_new_zipfile_serialization=zipped)
        whole, path = buffer.getvalue(), tmp_path / f"{zipped}.pt"
        for size in range(0, len(whole), 7):
            path.write_bytes(whole[:size])
            with pytest.raises(ValueError, match="expected a checkpoint"):
                read_checkpoint(path)
        for _ in range(400):
            changed = bytearray(whole)
            changed[generator.integers(len(whole))] = generator.integers(256)
            path.write_bytes(changed)
            try:
                assert all(tensor.numel() <= 6 for tensor in read_checkpoint(path).values())
            except ValueError as error:
                assert str(error).startswith(str(path)), changed  # noqa: PT017
                assert "\n" not in str(error)  # noqa: PT017


# --- files that are something else --------------------------------------------------------------------------------------


KINDS = {
    "empty": (b"", "an empty file: the download failed"),
    "html": (b"\n<!DOCTYPE html>\n<html><head>Quota exceeded</head></html>", "an HTML page: the download failed"),
    "xml": (b"<?xml version='1.0'?><Error>AccessDenied</Error>", "an XML document"),
    "lfs": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n", "a Git LFS pointer, .*git lfs pull"),
    "png": (b"\x89PNG\r\n\x1a\n123", "a PNG picture"),
    "jpeg": (b"\xff\xd8\xff\xe0" + b"x" * 50, "a JPEG picture"),
    "gzip": (b"\x1f\x8b\x08" + b"x" * 50, "a gzip file: unpack"),
    "keras": (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    "npy": (b"\x93NUMPY\x01\x00", "a numpy array"),
    "zeros": (bytes(5000), "a file of zeros"),
    "tar": (b"x" * 257 + b"ustar" + bytes(250), "a tar archive"),
    "text": (b"cat, dog\nhouse\n", "a text file that begins 'cat, dog'"),
    "umlaut": ("Tür\n".encode() * 500, "a text file that begins 'T"),
    "json": (b'{"weight_map": {}}', "a JSON file .*index"),
    "blank": (b"  \n ", "a blank text file"),
    "random": (b"\x07\x00\xfe\x13" * 40, "a file of an unknown kind"),
    "pickle": (pickle.dumps({"a": [1, 2]}), "a plain pickle of a dict with keys a"),
    "zip": (zip_of({"photo.txt": b"hello"}), r"a zip archive that torch.save did not write \(it holds photo.txt"),
    "no records": (zip_of({}), "an empty zip archive"),
    "compressed": (
        zip_of({"a/data.pkl": bytes(10**6)}, zipfile.ZIP_DEFLATED),
        "an archive that is compressed or encrypted",
    ),
    "cut safetensors": (
        struct.pack("<Q", 80) + b'{"a":{"dtype":"F32","shape":[2],',
        "a .safetensors file that is damaged",
    ),
    "empty safetensors": (struct.pack("<Q", 2) + b"{}", "a .safetensors file without tensors"),
    "no storage": (
        zip_of({"x/data.pkl": rebuilt(FLOATS.format(4), "I0\n(I2\nt(I1\ntI00\n(d")}),
        "an archive without its record data/0",
    ),
    "big-endian": (
        zip_of({"x/data.pkl": b"N.", "x/byteorder": b"big"}),
        "one written on a machine of the other byte order",
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_other_files_are_named(tmp_path: Path, kind: str) -> None:
    content, match = KINDS[kind]
    (tmp_path / "a.ckpt").write_bytes(content)
    with pytest.raises(ValueError, match=rf"expected a checkpoint .*, got {match}") as caught:
        read_checkpoint(tmp_path / "a.ckpt")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "match"),
    [
        (torch.ones(3), "a file of one tensor, without a state dict"),
        ({"epoch": 3, "loss": [1.0]}, "a file of a dict with keys epoch, loss, without a state dict"),
        ({}, "an empty dict"),
        ([torch.ones(3)], "one list"),
        (argparse.Namespace(a=1), "one object, argparse.Namespace"),
        (torch.nn.Linear(2, 2), r"one object, torch.nn.modules.linear.Linear \(save its state_dict\(\)"),
        ({"a": torch.eye(2).to_sparse(), "b": torch.ones(1)}, "entry a is no plain dense tensor"),
        (
            {"a": torch.ones(1).expand(1000)},
            "tensor a of size .1000. does not fit into the 1 values .*save it contiguous.$",
        ),
        ({"a": torch.complex(torch.ones(2), torch.ones(2)).conj()}, "entry a is no plain dense tensor"),
    ],
)
def test_what_torch_saves_beside_state_dicts_is_named(tmp_path: Path, value: object, match: str) -> None:
    torch.save(value, tmp_path / "a.pt")
    with pytest.raises(ValueError, match=match):
        read_checkpoint(tmp_path / "a.pt")


def test_torchscript_is_refused(tmp_path: Path) -> None:
    source = zip_of({"net/data.pkl": b"N.", "net/constants.pkl": b").", "net/code/__torch__.py": b"import os"})
    (tmp_path / "a.pt").write_bytes(source)
    with pytest.raises(ValueError, match=r"got a TorchScript archive, which is a program; save its state_dict\(\)"):
        read_checkpoint(tmp_path / "a.pt")


def test_no_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a\.ckpt: expected a checkpoint .* got no such file"):
        read_checkpoint(tmp_path / "a.ckpt")
    with pytest.raises(FileNotFoundError, match=r"a\.ckpt: expected a checkpoint .* got no such file"):
        weights_digest(tmp_path / "a.ckpt")
    for read in (read_checkpoint, weights_digest):
        with pytest.raises(ValueError, match="got a folder; name the file of weights in it"):
            read(tmp_path)


@pytest.mark.parametrize("read", [read_checkpoint, weights_digest])
def test_what_the_system_refuses_is_one_line(tmp_path: Path, read) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"x: expected a checkpoint .* got a name too long for a file; check it"
    ):
        read(tmp_path / ("x" * 256))
    with pytest.raises(
        ValueError, match=r"^/proc/self/mem: expected .* got one that cannot be read \(.+\); check the file"
    ):
        read("/proc/self/mem")


def test_a_dict_in_itself_many_times_is_looked_into_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dict under all seven usual keys of itself: looked through 400 times if each way to it counted."""
    value: dict = {"epoch": 3}
    value |= dict.fromkeys(("state_dict", "model_state_dict", "model", "module", "net", "network", "params"), value)
    torch.save(value, tmp_path / "a.pt")
    looks = []
    monkeypatch.setattr(checkpoint, "_is_odd_tensor", lambda entry: looks.append(entry))
    with pytest.raises(ValueError, match="without a state dict"):
        read_checkpoint(tmp_path / "a.pt")
    assert len(looks) == len(value)


def test_a_misaligned_storage_is_copied_once_and_shared(tmp_path: Path) -> None:
    rebuild = "ctorch._utils\n_rebuild_tensor_v2\n({}I{}\n(I1\nt(I1\ntI00\n(dtR"
    values = np.arange(1 << 18, dtype=np.float32)
    items = "".join(f"S'{i}'\n{rebuild.format(FLOATS.format(values.size), i)}s" for i in range(300))
    for padding in range(1, 5):
        body = f"(d{items}".encode() + b"I1\n0" + b"N0" * padding + b"."
        (tmp_path / "a.pt").write_bytes(
            zip_of({"x/data.pkl": body, "x" * padding + "/data/0": b"", "x/data/0": values.tobytes()})
        )
        with zipfile.ZipFile(tmp_path / "a.pt") as archive:
            first = archive.getinfo("x/data/0").header_offset + 30 + len("x/data/0")
        if first % 4:
            break
    assert first % 4
    found = read_checkpoint(tmp_path / "a.pt")
    assert [int(found[str(i)]) for i in range(300)] == list(range(300))
    assert {found[str(i)].data_ptr() - 4 * i for i in range(300)} == {found["0"].data_ptr()}
    assert found["0"].data_ptr() % 4 == 0


def test_names_from_the_file_cannot_write_to_the_terminal(tmp_path: Path) -> None:
    name = "os\x1b[2J\nposix"
    body = b"\x80\x04\x8c" + bytes([len(name)]) + name.encode() + b"\x8c\x03abc\x93)R."
    (tmp_path / "a.pt").write_bytes(zip_of({"x/data.pkl": body}))
    with pytest.raises(ValueError, match=r"one object, os\\x1b\[2J\\nposix\.abc") as caught:
        read_checkpoint(tmp_path / "a.pt")
    assert str(caught.value).isprintable()
