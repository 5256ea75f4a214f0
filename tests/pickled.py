"""Torch files put together by hand, for tests: pickles that torch.save would not write, and archives around them."""

import io
import pickle
import struct
import zipfile


class Call:
    """Pickles as a call of `function`, which the pickle only names."""

    def __init__(self, function, *arguments, state=None) -> None:
        self.parts = (function, arguments, state) if state is not None else (function, arguments)

    def __reduce__(self):
        return self.parts


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


CONTAINERS = {"zip": archive, "legacy": legacy}
