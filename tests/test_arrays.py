"""Files of arrays that others wrote: what is damaged, or states more than it holds, is one error."""

import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused, tells
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from kfgs._arrays import FileError, read_array, read_arrays, read_safetensors, save_tensors


def npy(header: bytes, values: bytes = b"", version: tuple[int, int] = (1, 0)) -> bytes:
    """The bytes of a .npy file with any header."""
    length = struct.pack("<H" if version == (1, 0) else "<I", len(header))
    return b"\x93NUMPY" + bytes(version) + length + header + values


def stated(descr: str, shape: str, fortran: str = "False") -> bytes:
    return f"{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n".encode()


LIES = {
    "8 TiB": npy(stated("<f8", "(1099511627776,)"), b"1234"),
    "overflow to 0": npy(stated("<f4", "(4294967296, 4294967296)")),
    "beyond 64 bits": npy(stated("<f4", "(1000000000000000000000000, 0)")),
    "negative": npy(stated("<f4", "(-1, 2)")),
    "booleans as axes": npy(stated("<f4", "(True, -5)"), b"1234"),
    "one short": npy(stated("<f4", "(3,)"), b"\0" * 11),
    "open bracket": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (3,"),
    "token error": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (3L, '''\n"),
    "deep brackets": npy(b"(" * 9000),
    "deep minus": npy(b"-" * 9000 + b"1"),
    "long header": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1," * 9000 + b"), }", version=(2, 0)),
    "null bytes": npy(b"\0" * 64),
    "no text": npy(bytes(range(128, 256))),
    "structured": npy(b"{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (3,), }", b"\0" * 12),
    "nothing wide": npy(stated("<U0", "(4611686018427387904,)")),
    "dates": npy(stated("<M8[s]", "(1,)"), b"\0" * 8),
    "cut in the header": npy(stated("<f4", "(3,)"))[:20],
    "empty": b"",
    "text": b"no array at all",
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_a_header_that_lies_is_one_line(tmp_path, lie):
    (tmp_path / "a.npy").write_bytes(lie)
    zipped(tmp_path, {"class_id.npy": lie})
    for read, file in ((read_array, tmp_path / "a.npy"), (read_arrays, tmp_path / "a.npz")):
        with pytest.raises(FileError, match=tells(file, "cannot be read", "again")) as caught:
            read(file)
        assert len(str(caught.value)) < 500
        assert "\n" not in str(caught.value)


def test_pickled_objects_are_never_loaded(tmp_path):
    file, made = tmp_path / "a.npy", tmp_path / "made"

    class Harmful:
        def __reduce__(self):
            return (made.mkdir, ())

    np.save(file, np.array([Harmful(), 1], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", a=np.array([Harmful()], dtype=object))
    for read, name in ((read_array, "a.npy"), (read_arrays, "a.npz")):
        refused(lambda name=name, read=read: read(tmp_path / name), name, "cannot be read", error=FileError)
    assert not made.exists()


@pytest.mark.parametrize(
    "values",
    [
        np.arange(24, dtype=np.float32).reshape(2, 3, 4),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(5, dtype=">i2"),
        np.array([True, False]),
        np.float16([[1.5]]),
        np.array(7),
    ],
    ids=lambda values: f"{values.dtype}{values.shape}",
)
def test_arrays_are_read_as_numpy_wrote_them(tmp_path, values):
    np.save(tmp_path / "a.npy", values)
    found = read_array(tmp_path / "a.npy")
    assert found.dtype == values.dtype
    assert np.array_equal(found, values)
    assert isinstance(found, np.memmap)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="Linux lists open files")
def test_an_archive_with_the_name_of_an_array_is_refused_and_closed(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.arange(4))
    file = (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(FileError, match=tells(file, "cannot be read")) as caught:
        read_array(file)
    assert caught.value.__cause__ is not None  # its frames are alive, and so would be an open file
    assert file not in [link.readlink() for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]


def test_missing_files_are_named(tmp_path):
    for read, name in ((read_array, "a.npy"), (read_arrays, "a.npz"), (read_safetensors, "a.safetensors")):
        with pytest.raises(FileNotFoundError, match=tells(name, "no such file", "expected")):
            read(tmp_path / name)


def zipped(tmp_path, entries: dict[str, bytes], kind: int = zipfile.ZIP_DEFLATED):
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w", kind) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return file


def test_archives_are_read_as_numpy_wrote_them(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.arange(4), name=np.array("abc"), none=np.zeros((0, 3)))
    found = read_arrays(tmp_path / "a.npz")
    assert found["a"].tolist() == [0, 1, 2, 3]
    assert str(found["name"]) == "abc"
    assert found["none"].shape == (0, 3)


def test_an_archive_unpacks_to_no_more_than_allowed(tmp_path):
    zeros = io.BytesIO()
    np.save(zeros, np.zeros(90_000_000, np.uint8))
    file = zipped(tmp_path, {"a.npy": zeros.getvalue()})
    assert file.stat().st_size < 1_000_000
    refused(lambda: read_arrays(file), file, "unpack to 90000128 bytes", error=FileError)
    refused(lambda: read_arrays(file, most=1000), file, "at most 1000", error=FileError)


def test_a_damaged_archive_is_one_error(tmp_path):
    whole = zipped(tmp_path, {"a.npy": npy(stated("<f4", "(3,)"), b"\0" * 12)}, zipfile.ZIP_STORED).read_bytes()
    rng = np.random.default_rng(0)
    file = tmp_path / "b.npz"
    refused = 0
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(len(whole), size=3):
            damaged[place] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            read_arrays(file)
        except FileError:
            refused += 1
    assert refused > 100


def safetensors(header: object, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff" * 64,
        safetensors({"a": {"dtype": "F32", "shape": [1 << 40], "data_offsets": [0, 1 << 42]}}),
        safetensors({"a": {"dtype": "F32", "shape": [1 << 32, 1 << 32], "data_offsets": [0, 0]}}),
        safetensors({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 4]}}, b"\0" * 4),
        safetensors({"a": {"dtype": "NEW", "shape": [1], "data_offsets": [0, 4]}}, b"\0" * 4),
        safetensors(b"[" * 100_000),
        safetensors({"__metadata__": {"kfgs": 7}}),
    ],
    ids=["empty", "ff", "4 TiB", "overflow", "two for one", "new type", "nested", "number in metadata"],
)
def test_safetensors_that_lie_are_one_error(tmp_path, content):
    file = tmp_path / "a.safetensors"
    file.write_bytes(content)
    refused(lambda: read_safetensors(file), file, "cannot be read", "again", error=FileError)


def test_safetensors_say_their_kind_and_version(tmp_path):
    file = tmp_path / "a.safetensors"
    for metadata, told in (
        (None, ("got other tensors", "a kfgs codebook, version 1", "fit it")),
        ({"kfgs": "index maps", "version": "1"}, ("got index maps", "fit it")),
        ({"kfgs": "codebook", "version": "2"}, ("got version 2", "use the kfgs that wrote it")),
        ({"kfgs": "codebook"}, ("got version None", "use the kfgs that wrote it")),
    ):
        save_file({"a": torch.zeros(2)}, file, metadata=metadata)
        refused(lambda: read_safetensors(file, advice="fit it", kfgs=("codebook", "1")), file, *told, error=FileError)
    save_file({"a": torch.ones(2)}, file, metadata={"kfgs": "codebook", "version": "1", "more": "x"})
    tensors, metadata = read_safetensors(file, kfgs=("codebook", "1"))
    assert tensors["a"].tolist() == [1, 1]
    assert metadata["more"] == "x"


TEXTS = {
    "kfgs": 'a "kind"',
    "version": "1",
    "Größe": "\n\x01\x7f/\\ünï😀",
    "empty": "",
    **{f"{i}": "x" * i for i in range(9)},
}


def test_texts_and_tensors_come_back_in_the_order_given(tmp_path):
    path = tmp_path / "a.safetensors"
    tensors = {"b": torch.arange(6).view(2, 3).T, "a": torch.tensor([1.5], requires_grad=True), "none": torch.zeros(0)}
    save_tensors(path, tensors, TEXTS)
    with safe_open(path, framework="pt") as file:
        assert file.metadata() == TEXTS
    assert all(torch.equal(value, tensors[name].detach()) for name, value in load_file(path).items())
    head = path.read_bytes()
    places = [head.index(f'"{name}":'.encode()) for name in TEXTS]
    assert places == sorted(places)
    for _ in range(9):  # safetensors alone takes another order each time
        save_tensors(path, tensors, TEXTS)
        assert path.read_bytes() == head
