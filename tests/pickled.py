"""Torch files put together by hand, for tests: pickles that torch.save would not write, and archives around them."""

import io
import pickle
import pickletools
import struct
import zipfile
from collections import OrderedDict

import torch


class Call:
    """Pickles as a call of `function`, which the pickle only names."""

    def __init__(self, function, *arguments, state=None) -> None:
        self.parts = (function, arguments, state) if state is not None else (function, arguments)

    def __reduce__(self):
        return self.parts


class Stored:
    """Pickles as a reference to a storage."""

    def __init__(self, *key) -> None:
        self.key = key


class Pickler(pickle.Pickler):
    def persistent_id(self, value):
        return value.key if isinstance(value, Stored) else None


def pickled(value: object) -> bytes:
    data = io.BytesIO()
    Pickler(data, 2).dump(value)
    return data.getvalue()


def tensor(offset=0, size=(4,), stride=(1,), numel=4, *, legacy: bool = False) -> Call:
    """What a float tensor in a file is: a call of torch."""
    key = ("storage", torch.FloatStorage, "0", "cpu", numel)
    storage = Stored(*key, None) if legacy else Stored(*key)
    return Call(torch._utils._rebuild_tensor_v2, storage, offset, size, stride, False, OrderedDict())


def text(value: str) -> bytes:
    """The opcode of a text."""
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def zip_of(records: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", compression) as archive:
        for name, content in records.items():
            archive.writestr(name, content)
    return data.getvalue()


def archive(body: bytes, *storages: bytes) -> bytes:
    """A file of torch >= 1.6."""
    return zip_of({"x/data.pkl": body, "x/version": b"3\n"} | {f"x/data/{i}": data for i, data in enumerate(storages)})


def legacy(body: bytes, *storages: bytes) -> bytes:
    """A file of torch < 1.6; storages hold floats."""
    head = [0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}]
    keys = pickle.dumps([str(i) for i in range(len(storages))], 2)
    values = b"".join(struct.pack("<q", len(data) // 4) + data for data in storages)
    return b"".join(pickle.dumps(part, 2) for part in head) + body + keys + values


def lightning(body: bytes) -> bytes:
    """A good checkpoint, whose dict has one item more: `body`."""
    good = io.BytesIO()
    torch.save({"state_dict": {"a": torch.ones(2)}, "callbacks": None}, good)
    with zipfile.ZipFile(good) as file:
        records = {info.filename: file.read(info) for info in file.infolist()}
    root = next(name for name in records if name.endswith("data.pkl"))
    assert records[root].endswith(b"u.")
    records[root] = records[root][:-1] + text("evil") + _inside(body) + b"s."
    return zip_of(records)


def _inside(body: bytes) -> bytes:
    """A pickle without its protocol, frames and end, to be put into another one."""
    spans = [(opcode.name, position) for opcode, _, position in pickletools.genops(body)]
    ends = [position for _, position in spans[1:]] + [len(body)]
    return b"".join(
        body[start:end]
        for (name, start), end in zip(spans, ends, strict=True)
        if name not in ("PROTO", "FRAME", "STOP", "MEMOIZE", "BINPUT")
    )


CONTAINERS = {"pickle": lambda body: body, "zip": archive, "legacy": legacy, "lightning": lightning}
