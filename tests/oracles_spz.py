"""SPZ by hand: build a legacy payload byte by byte, and read one Gaussian of it with plain arithmetic."""

import math
import struct

HEADER = struct.Struct("<4sIIBBBB")


def legacy_payload(
    rows: list[dict], *, version: int, degree: int = 0, bits: int = 12, flags: int = 0, extensions: bytes = b""
) -> bytes:
    """The plain bytes of a version 1 to 3 file; each row has raw `position`, `alpha`, `color`, `scale`, `rotation`, `sh`."""
    out = HEADER.pack(b"NGSP", version, len(rows), degree, bits, flags, 0)
    for row in rows:
        for value in row["position"]:
            out += struct.pack("<e", value) if version == 1 else (value & 0xFFFFFF).to_bytes(3, "little")
    out += bytes(row["alpha"] for row in rows)
    for name in ("color", "scale"):
        out += b"".join(bytes(row[name]) for row in rows)
    for row in rows:
        out += bytes(row["rotation"]) if version < 3 else struct.pack("<I", row["rotation"])
    return out + b"".join(bytes(row.get("sh", [])) for row in rows) + extensions


def smallest_three(word: int) -> list[float]:
    """The quaternion (x, y, z, w) of a version 3 word: from the lowest ten bits up, w first, the largest left out."""
    largest, quat = word >> 30, [0.0] * 4
    for axis in (3, 2, 1, 0):
        if axis != largest:
            size = (word & 511) / 511 / math.sqrt(2)
            quat[axis] = -size if word & 512 else size
            word >>= 10
    quat[largest] = math.sqrt(1 - sum(v * v for v in quat))
    return quat
