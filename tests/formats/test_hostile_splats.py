"""Damaged and hostile files of every format: a ValueError that names the file, in bounded memory, or a sound cloud."""

import gzip
import io
import itertools
import json
import re
import struct
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch
from cases_gltf import random_cloud
from oracles_spz import legacy_payload

from kfgs.formats import read_splats, write_splats
from kfgs.formats.table import formats

MOST_MEMORY = 48 << 20  # bytes, for files of a few kB
MOST_SECONDS = 5.0
FLIPS, CUTS = 120, 60
FORMATS = [name for name, module in formats().items() if hasattr(module, "write")]
KINDS = [*FORMATS, "gltf-text", "ascii", "spz-2", "ksplat"]


@pytest.fixture(scope="module")
def sound(tmp_path_factory, request):
    """A sound file of each kind: its ending and its bytes."""
    folder = tmp_path_factory.mktemp("sound")

    def make(kind: str) -> tuple[str, bytes]:
        if kind == "ksplat":
            shared = request.getfixturevalue("shared_data")
            return ".ksplat", (shared / "splats" / "minimal.ksplat").read_bytes()
        if kind == "ascii":
            names = ["x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
            head = "".join(f"property float {name}\n" for name in names)
            rows = "\n".join(" ".join(f"{i + j / 8:g}" for j in range(len(names))) for i in range(6))
            return ".ply", f"ply\nformat ascii 1.0\nelement vertex 6\n{head}end_header\n{rows}\n".encode()
        if kind == "spz-2":
            row = {"position": (256, -512, 768), "alpha": 51, "color": (0, 128, 255), "scale": (160, 128, 96)}
            return ".spz", gzip.compress(legacy_payload([row | {"rotation": (191, 64, 200)}] * 40, version=2))
        suffix = ".gltf" if kind == "gltf-text" else formats()[kind].SUFFIXES[0]
        write_splats(random_cloud(40, 1, labels=torch.arange(40) % 3, names=("a", "b", "c")), folder / f"a{suffix}")
        return suffix, (folder / f"a{suffix}").read_bytes()

    return make


def _read(path, content: bytes) -> str:
    """Read a file of that content: "sound" or "refused"; anything else fails."""
    path.write_bytes(content)
    start = time.process_time()
    tracemalloc.start()
    splats, message = None, ""
    try:
        splats = read_splats(path)
    except ValueError as error:
        message = str(error)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MOST_MEMORY, f"{peak / 2**20:.0f} MiB for {len(content)} bytes"
    assert time.process_time() - start < MOST_SECONDS
    if splats is None:
        assert str(path) in message, f"the message does not name the file: {message}"
    else:
        g = splats
        assert len(g) <= 8 * len(content)
        assert all(bool(getattr(g, key).isfinite().all()) for key in ("means", "scales", "opacities", "quats"))
        assert bool((g.scales > 0).all())
        assert g.sh is None or bool(g.sh.isfinite().all())
        assert bool(((g.opacities >= 0) & (g.opacities <= 1)).all())
    assert [file.name for file in path.parent.iterdir()] == [path.name], "reading leaves files behind"
    return "refused" if splats is None else "sound"


@pytest.mark.parametrize("kind", KINDS)
def test_files_cut_short(tmp_path, sound, kind):
    suffix, content = sound(kind)
    path = tmp_path / f"bad{suffix}"
    assert _read(path, content) == "sound"
    cuts = sorted({*range(0, 40, 3), *np.linspace(0, len(content) - 1, CUTS).astype(int).tolist()})
    refused = sum(_read(path, content[:cut]) == "refused" for cut in cuts)
    whole_records = sum(cut % 32 == 0 for cut in cuts) if kind == "splat" else 0  # .splat has no header
    optional = 4 if kind in ("ascii", "gltf-text", "ksplat") else 0  # white space or unused bytes at the end
    assert refused >= len(cuts) - whole_records - optional


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_changed_at_random(tmp_path, sound, kind):
    suffix, content = sound(kind)
    rng = np.random.default_rng(KINDS.index(kind))
    for trial in range(FLIPS):
        bent = bytearray(content)
        reach = min(len(bent), 256) if trial % 2 else len(bent)  # every second one in the header
        for place in rng.integers(0, reach, rng.integers(1, 4)):
            bent[place] = rng.integers(0, 256)
        _read(tmp_path / f"bad{suffix}", bytes(bent))


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_in_the_header_made_huge(tmp_path, sound, kind):
    suffix, content = sound(kind)
    for place in range(0, min(len(content) - 8, 72), 2):
        for huge in (struct.pack("<I", 0xFFFFFFFF), struct.pack("<I", 0x3FFFFFFF), struct.pack("<Q", 2**40), bytes(4)):
            _read(tmp_path / f"bad{suffix}", content[:place] + huge + content[place + len(huge) :])


@pytest.mark.parametrize("kind", ["ply", "compressed_ply", "gltf-text", "ascii"])
def test_numbers_in_a_text_made_huge(tmp_path, sound, kind):
    """Every number of the header, one at a time, becomes a thousand million, negative, and no number at all."""
    suffix, content = sound(kind)
    text = content[: content.index(b"end_header")] if b"end_header" in content else content
    numbers = [match for match in re.finditer(rb"(?<![\w.+/])\d+(?![\w.+/])", text)][:60]
    assert len(numbers) >= 1
    for match in numbers:
        for other in (b"1000000000", b"-1", b"99999999999999999999", b"x"):
            bent = content[: match.start()] + other + content[match.end() :]
            _read(tmp_path / f"bad{suffix}", bent)


def _places(value, path=()):
    """Every place in a JSON document, as the keys that lead there."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        if not (isinstance(key, int) and key > 3):  # long lists repeat themselves
            yield from _places(child, (*path, key))


def _documents(root):
    """The document with one place after the other exchanged for what should not be there."""
    kinds = itertools.cycle((None, True, -1, 3, 1e300, "x", [], [[]], {}, {"a": {}}, 2**70))
    for path in _places(root):
        for odd in itertools.islice(kinds, 5):
            if not path:
                yield odd
                continue
            bent = json.loads(json.dumps(root))
            holder = bent
            for key in path[:-1]:
                holder = holder[key]
            holder[path[-1]] = odd
            yield bent


def test_any_value_in_the_json_of_gltf(tmp_path, sound):
    suffix, content = sound("gltf-text")
    root = json.loads(content)
    root["extensionsRequired"] = ["KHR_gaussian_splatting"]
    placed = {"mesh": 0, "rotation": [0, 0, 1, 0], "translation": [1, 2, 3]}
    root["nodes"] = [{"children": [1], "scale": [2, 2, 2]}, placed]
    root["bufferViews"][0]["byteStride"] = 12
    root["accessors"][0]["normalized"] = False
    outcomes = [_read(tmp_path / f"bad{suffix}", json.dumps(bent).encode()) for bent in _documents(root)]
    assert outcomes.count("refused") > 100


def test_any_value_in_the_json_of_sog(tmp_path, sound):
    suffix, content = sound("sog")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    root = json.loads(files["meta.json"])
    outcomes = []
    for bent in _documents(root):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for name, data in (files | {"meta.json": json.dumps(bent).encode()}).items():
                archive.writestr(name, data)
        outcomes.append(_read(tmp_path / f"bad{suffix}", buffer.getvalue()))
    assert outcomes.count("refused") > 100


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".glb", ".gltf", ".ksplat", ".splat"])
@pytest.mark.parametrize(
    "content", [b"", b"\0", b"\0" * 1000, b"\xff" * 1000, b"hello\n" * 50, b"{}", b"ply\n", b"PK\x03\x04"]
)
def test_what_is_no_splat_file_is_refused(tmp_path, suffix, content):
    outcome = _read(tmp_path / f"bad{suffix}", content)
    assert outcome == "refused" or (suffix == ".splat" and len(content) % 32 == 0)
