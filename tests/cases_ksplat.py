"""Files in the .ksplat format, put together byte by byte."""

import struct

import numpy as np

C0 = 0.28209479177387814
SH = np.arange(24) / 16 - 0.75  # of one Gaussian, as stored: band by band, red, green, blue
ROWS = [  # position, scale, quaternion (w, x, y, z), colour and opacity
    ((1.5, -2.0, 3.25), (0.5, 0.25, 2.0), (0.5, 0.5, -0.5, 0.5), (0, 255, 51, 102)),
    ((-4.0, 0.5, 0.125), (1.0, 1.0, 0.5), (1.0, 0.0, 0.0, 0.0), (9, 8, 7, 255)),
    ((7.0, 7.5, -0.5), (1.0, 1.0, 0.5), (0.0, 1.0, 0.0, 0.0), (9, 8, 7, 255)),
]
CENTRES = [(1.0, -2.0, 3.0), (-4.0, 0.0, 0.0), (7.0, 7.0, 0.0)]
BLOCK, QUANTUM = 5.0, 32767


def ksplat_row(level: int, i: int, degree: int) -> bytes:
    position, scale, quat, rgba = ROWS[i]
    sh = SH[: 3 * ((degree + 1) ** 2 - 1)]
    real = "f" if level == 0 else "e"
    if level == 0:
        out = struct.pack("<3f", *position)
    else:
        steps = [round((p - c) / (BLOCK / 2) * QUANTUM) + QUANTUM for p, c in zip(position, CENTRES[i], strict=True)]
        out = struct.pack("<3H", *steps)
    out += struct.pack(f"<7{real}", *scale, *quat) + bytes(rgba)
    if level == 2:
        return out + bytes(round((v + 1.5) / 3 * 255) for v in sh)
    return out + struct.pack(f"<{len(sh)}{real}", *sh)


def ksplat_section(
    level: int, rows: list[int], degree: int, full: int, lengths: list[int], **changes
) -> tuple[bytes, bytes]:
    """Header and data: `full` buckets of one Gaussian each, then partly filled buckets of the lengths given."""
    buckets = full + len(lengths)
    values = {"size": len(rows), "capacity": len(rows), "bucket": 1, "buckets": buckets, "block": BLOCK, "bytes": 12}
    values |= {"quantum": QUANTUM, "full": full, "partial": len(lengths), "sh_degree": degree} | changes
    head = struct.pack("<IIIIfH2xI4xIIH", *values.values()).ljust(1024, b"\0")
    centres = b"".join(struct.pack("<3f", *CENTRES[i]) for i in rows[:buckets])
    data = struct.pack(f"<{len(lengths)}I", *lengths) + centres + b"".join(ksplat_row(level, i, degree) for i in rows)
    return head, data


def ksplat_file(level: int, sections: list[tuple[bytes, bytes]], count: int, **changes) -> bytes:
    values = {"major": 0, "minor": 1, "most": len(sections), "used": len(sections), "max": count, "count": count}
    values |= {"level": level, "low": -1.5, "high": 1.5} | changes
    head = struct.pack("<BB2xIIIIH14xff", *values.values()).ljust(4096, b"\0")
    return head + b"".join(h for h, _ in sections) + b"".join(d for _, d in sections)
