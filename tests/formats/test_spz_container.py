"""SPZ containers by hand: versions 1 to 4, damaged in every way; whatever they promise costs no memory."""

import gzip
import struct
import tracemalloc

import pytest
import zstandard
from messages import refused
from oracles_spz import legacy_payload

from kfgs.formats import read_splats
from kfgs.formats.spz import read

ROW = {"position": (256, -512, 768), "alpha": 51, "color": (0, 128, 255), "scale": (160, 128, 96)}


def _v4(count=2, degree=0, bits=12, flags=0, streams=None, sizes=None, start=32, number=None, extensions=b""):
    """A version 4 file of zeros, or with something wrong in it."""
    plain = [9 * count, count, 3 * count, 3 * count, 4 * count]
    packed = [zstandard.compress(b"\0" * size) for size in plain] if streams is None else streams
    number = len(packed) if number is None else number
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags, number, start)
    table = b"".join(struct.pack("<QQ", len(p), s) for p, s in zip(packed, sizes or plain, strict=False))
    return head + extensions + table + b"".join(packed)


def _ext(kind, payload, length=None):
    return struct.pack("<II", kind, len(payload) if length is None else length) + payload


def _unsized(data):
    """A Zstandard frame that does not say how long it is."""
    return zstandard.ZstdCompressor(write_content_size=False).compress(data)


_GOOD = legacy_payload([ROW | {"rotation": 0}] * 3, version=3)
_BOMB = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(1 << 25)

BAD = {
    "not spz": b"hello",
    "other gzip": gzip.compress(b"x" * 99),
    "cut gzip": gzip.compress(_GOOD)[:-9],
    "damaged gzip": gzip.compress(_GOOD)[:-8] + bytes(8),
    "bytes in gzip": gzip.compress(_GOOD + b"x"),
    "bytes after raw": _GOOD + b"x",
    "cut raw": _GOOD[:-1],
    "gzip bomb": gzip.compress(_BOMB),
    "4 billion in gzip": gzip.compress(_GOOD[:8] + b"\xff\xff\xff\xff" + _GOOD[12:]),
    "4 billion": _v4()[:8] + b"\xff\xff\xff\xff" + _v4()[12:],
    "20 million": _v4()[:8] + struct.pack("<I", 20_000_000) + _v4()[12:],
    "degree 7": gzip.compress(_GOOD[:12] + b"\x07" + _GOOD[13:]),
    "40 bits": gzip.compress(_GOOD[:13] + b"\x28" + _GOOD[14:]),
    "version 5": _v4()[:4] + b"\x05" + _v4()[5:],
    "version 4 in gzip": gzip.compress(_GOOD[:4] + b"\x04" + _GOOD[5:]),
    "short header": _v4()[:30],
    "table outside": _v4(start=4000),
    "cut streams": _v4()[:-1],
    "garbage after": _v4() + b"xyz",
    "size in table": _v4(sizes=[18, 2, 6, 6, 1 << 40]),
    "frame promises": _v4(streams=[zstandard.compress(bytes(n)) for n in (1 << 26, 2, 6, 6, 8)]),
    "unsized frame, short": _v4(streams=[_unsized(bytes(n - 1)) for n in (18, 2, 6, 6, 8)]),
    "unsized frame, long": _v4(streams=[_unsized(bytes(1 << 20))] * 5),
    "long record": _v4(start=44, flags=2, extensions=_ext(7, b"abcd", 99)),
    "axes": _v4(start=44, flags=2, extensions=_ext(0xADBE0003, b"\x0c\0\0\0")),
}


@pytest.mark.parametrize("case", BAD)
def test_damage_is_named_and_costs_no_memory(tmp_path, case):
    (tmp_path / "bad.spz").write_bytes(BAD[case])
    tracemalloc.start()
    try:
        refused(lambda: read_splats(tmp_path / "bad.spz"), "bad.spz: expected")
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()


def test_records_after_the_streams_unpack_to_no_more_than_allowed(tmp_path):
    content = gzip.compress(_GOOD[:14] + b"\x02" + _GOOD[15:] + bytes(1 << 28))
    (tmp_path / "bad.spz").write_bytes(content)
    tracemalloc.start()
    refused(lambda: read_splats(tmp_path / "bad.spz"), "bad.spz:", "it has more")
    assert tracemalloc.get_traced_memory()[1] < 2 * ((64 << 20) + 100 * len(content))
    tracemalloc.stop()


def test_the_undamaged_files_of_these_tests_are_read(tmp_path):
    unsized = [_unsized(bytes(n)) for n in (18, 2, 6, 6, 8)]
    no_harmonics = [zstandard.compress(bytes(n)) for n in (18, 2, 6, 6, 8)] + [b""]  # six streams at degree 0
    good = [
        _v4(),
        _v4(streams=unsized),
        _v4(streams=no_harmonics, sizes=[18, 2, 6, 6, 8, 0]),
        _v4(start=44, flags=2, extensions=_ext(7, b"abcd")),
        gzip.compress(_GOOD),
        _GOOD,
    ]
    for content in good:
        (tmp_path / "good.spz").write_bytes(content)
        assert len(read(tmp_path / "good.spz")) in (1, 2, 3)


def test_several_gzip_members_are_one_stream(tmp_path):
    data = legacy_payload([ROW | {"rotation": 0xC0000000}] * 5, version=3)
    (tmp_path / "a.spz").write_bytes(gzip.compress(data[:30]) + gzip.compress(data[30:]) + b"\0" * 7)
    assert len(read(tmp_path / "a.spz")) == 5
