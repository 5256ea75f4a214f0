import struct

import numpy as np
import pytest
import torch
from messages import tells

from kfgs.formats import read_splats, write_splats
from kfgs.formats.ksplat import matches, read

C0 = 0.28209479177387814
SH = np.arange(24) / 16 - 0.75  # of one Gaussian, as stored: band by band, red, green, blue
ROWS = [  # position, scale, quaternion (w, x, y, z), colour and opacity
    ((1.5, -2.0, 3.25), (0.5, 0.25, 2.0), (0.5, 0.5, -0.5, 0.5), (0, 255, 51, 102)),
    ((-4.0, 0.5, 0.125), (1.0, 1.0, 0.5), (1.0, 0.0, 0.0, 0.0), (9, 8, 7, 255)),
    ((7.0, 7.5, -0.5), (1.0, 1.0, 0.5), (0.0, 1.0, 0.0, 0.0), (9, 8, 7, 255)),
]
CENTRES = [(1.0, -2.0, 3.0), (-4.0, 0.0, 0.0), (7.0, 7.0, 0.0)]
BLOCK, QUANTUM = 5.0, 32767


def _row(level: int, i: int, degree: int) -> bytes:
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


def _section(level: int, rows: list[int], degree: int, full: int, lengths: list[int], **changes) -> tuple[bytes, bytes]:
    """Header and data: `full` buckets of one Gaussian each, then partly filled buckets of the lengths given."""
    buckets = full + len(lengths)
    values = {"size": len(rows), "capacity": len(rows), "bucket": 1, "buckets": buckets, "block": BLOCK, "bytes": 12}
    values |= {"quantum": QUANTUM, "full": full, "partial": len(lengths), "sh_degree": degree} | changes
    head = struct.pack("<IIIIfH2xI4xIIH", *values.values()).ljust(1024, b"\0")
    centres = b"".join(struct.pack("<3f", *CENTRES[i]) for i in rows[:buckets])
    data = struct.pack(f"<{len(lengths)}I", *lengths) + centres + b"".join(_row(level, i, degree) for i in rows)
    return head, data


def _file(level: int, sections: list[tuple[bytes, bytes]], count: int, **changes) -> bytes:
    values = {"major": 0, "minor": 1, "most": len(sections), "used": len(sections), "max": count, "count": count}
    values |= {"level": level, "low": -1.5, "high": 1.5} | changes
    head = struct.pack("<BB2xIIIIH14xff", *values.values()).ljust(4096, b"\0")
    return head + b"".join(h for h, _ in sections) + b"".join(d for _, d in sections)


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_and_degree_by_hand(tmp_path, level, degree):
    sections = [_section(level, [0, 1], degree, 1, [1]), _section(level, [2], 0, 0, [1])]
    (tmp_path / "a.ksplat").write_bytes(_file(level, sections, 3))
    splats = read(tmp_path / "a.ksplat")
    assert splats.info == {"format": "ksplat", "version": "0.1", "level": level}
    g = splats.gaussians
    np.testing.assert_allclose(g.means, [row[0] for row in ROWS], atol=0 if level == 0 else BLOCK / 4 / QUANTUM + 1e-6)
    np.testing.assert_array_equal(g.scales, [row[1] for row in ROWS])
    np.testing.assert_allclose(g.quats, [row[2] for row in ROWS])
    np.testing.assert_allclose(0.5 + C0 * g.sh[:, 0], np.array([row[3][:3] for row in ROWS]) / 255, atol=1e-6)
    np.testing.assert_allclose(g.opacities, [row[3][3] / 255 for row in ROWS])
    assert g.sh.shape == (3, (degree + 1) ** 2, 3)
    within = 0.5 * 3 / 255 + 1e-6 if level == 2 else 1e-3
    for band, first in ((1, 0), (2, 9)):
        if degree >= band:
            size = 2 * band + 1
            stored = SH[first : first + 3 * size].reshape(3, size)  # channel, then coefficient
            np.testing.assert_allclose(g.sh[1, band**2 : (band + 1) ** 2], stored.T, atol=within)
    assert not g.sh[2, 1:].any()  # the section of degree 0


def test_empty_sections_say_nothing(tmp_path):
    sections = [_section(1, [], 0, 0, [], sh_degree=2), _section(1, [0, 2, 1], 1, 0, [1, 2], capacity=3, buckets=2)]
    (tmp_path / "a.ksplat").write_bytes(_file(1, sections, 3))
    g = read(tmp_path / "a.ksplat").gaussians
    assert g.sh.shape == (3, 4, 3)
    np.testing.assert_allclose(g.means[:2], [ROWS[0][0], ROWS[2][0]], atol=1e-4)
    shifted = np.array(ROWS[1][0]) - CENTRES[1] + CENTRES[2]  # the third one lies in the bucket of the second
    np.testing.assert_allclose(g.means[2], shifted, atol=1e-4)


def test_the_fixture_is_the_scene_of_the_splat_file(shared_data):
    ours = read_splats(shared_data / "splats" / "minimal.ksplat").gaussians
    other = read_splats(shared_data / "splats" / "minimal.splat").gaussians
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(ours, name), getattr(other, name), rtol=0, atol=1e-6)


def test_it_is_known_by_its_content(tmp_path):
    data = _file(1, [_section(1, [0, 1, 2], 0, 3, [])], 3)
    (tmp_path / "a.bin").write_bytes(data)
    assert read_splats(tmp_path / "a.bin").info["format"] == "ksplat"
    assert not matches(bytes(6000))
    assert not matches(b"ply\n" + bytes(6000))


def test_it_is_only_read(tmp_path, shared_data):
    splats = read_splats(shared_data / "splats" / "minimal.ksplat")
    with pytest.raises(ValueError, match=tells("path:", "got 'a.ksplat'")):
        write_splats(tmp_path / "a.ksplat", splats)


_S = _section(1, [0, 1], 1, 1, [1])
_NAN = bytearray(_file(0, [_section(0, [0], 0, 1, [])], 1))
_NAN[-44:-40] = np.float32(np.nan).tobytes()
BAD = {
    "short": (bytes(100), ("4096", "got 100")),
    "version": (_file(1, [_S], 2, major=1), ("version 0.1", "got 1.1 and 1")),
    "minor": (_file(1, [_S], 2, minor=0), ("got 0.0 and 1",)),
    "level": (_file(7, [_S], 2), ("got 0.1 and 7",)),
    "sections": (_file(1, [_S], 2, most=4_000_000_000), ("4000000000 sections",)),
    "count": (_file(1, [_S], 5), ("expected 5 Gaussians", "got 2")),
    "none": (_file(1, [], 0), ("expected 0 Gaussians", "got 0")),
    "capacity": (_file(1, [_section(1, [0], 0, 1, [], capacity=4_000_000_000)], 1), ("4000000000 Gaussians",)),
    "size": (_file(1, [_section(1, [0], 0, 1, [], size=9)], 1), ("1 Gaussians", "got 9", "degree 0")),
    "degree": (_file(1, [_section(1, [0], 0, 1, [], sh_degree=77)], 1), ("degree 0 to 2", "degree 77")),
    "buckets": (_file(1, [_section(1, [0, 1], 0, 2, [], buckets=1, bucket=7)], 2), ("damaged",)),
    "full": (_file(1, [_section(1, [0, 1], 0, 1, [0])], 2), ("2 buckets", "2 Gaussians", "got 1 of 1 and 1 of 0")),
    "bytes": (_file(1, [_section(1, [0], 0, 1, [], bytes=11)], 1), ("bucket", "12", "got 11")),
    "cut": (_file(1, [_S], 2)[:-1], ("2 Gaussians", "42 bytes", "truncated")),
    "more": (_file(1, [_S], 2) + b"x", ("expected 2 Gaussians", "damaged")),
    "nan": (bytes(_NAN), ("got [nan, -2.0, 3.25]",)),
    "wide block": (_file(1, [_section(1, [0], 0, 1, [], block=3e38, quantum=1)], 1), ("got [inf, inf, inf]",)),
    "block": (_file(1, [_section(1, [0], 0, 1, [], block=float("nan"))], 1), ("got [nan, nan, nan]",)),
    "half": (_file(1, [_S], 2)[:-2] + b"\x00\x7c", ("finite", "inf", "Gaussian 1")),
}


@pytest.mark.parametrize("case", BAD)
def test_damage_is_named(tmp_path, case):
    content, message = BAD[case]
    (tmp_path / "bad.ksplat").write_bytes(content)
    with pytest.raises(ValueError, match=tells("bad.ksplat:", *message)):
        read_splats(tmp_path / "bad.ksplat")
