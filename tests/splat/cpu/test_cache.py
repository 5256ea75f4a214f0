"""Kernels on disk: taken from there when nothing has changed, compiled again otherwise, and quick to call."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from zlib import crc32

import pytest

pytest.importorskip("numba")

from kfgs.splat.engines.cpu import cache as numba_cache

FILE = Path(numba_cache.__file__)

KERNELS = """
from typing import NamedTuple

import numpy as np
from numba import njit


class Pair(NamedTuple):
    left: np.ndarray
    right: np.ndarray


@njit
def double(x):
    return 2 * x


def decorate(cached_njit):
    @cached_njit(nogil=True)
    def kernel(pair, out):
        for i in range(len(out)):
            out[i] = double(pair.left[i]) + pair.right[i]

    return kernel
"""

DRIVER = """
import importlib.util, json, sys
import numpy as np

file, dtype = sys.argv[1:]
spec = importlib.util.spec_from_file_location("numba_cache", file)
numba_cache = importlib.util.module_from_spec(spec)
spec.loader.exec_module(numba_cache)
import kernels


def probe():  # a call of Python, which the profiler must see
    pass


kernel = kernels.decorate(numba_cache.cached_njit)
pair, out = kernels.Pair(np.arange(3, dtype=dtype), np.ones(3, dtype)), np.zeros(3, dtype)
kernel(pair, out)
python_calls = []
sys.setprofile(lambda frame, event, _: python_calls.append(frame.f_code.co_name) if event == "call" else None)
probe()
kernel(pair, out)
sys.setprofile(None)
print(json.dumps({
    "out": out.tolist(),
    "hits": sum(kernel.stats.cache_hits.values()),
    "misses": sum(kernel.stats.cache_misses.values()),
    "python calls": python_calls,
}))
"""


def test_later_processes_take_the_kernel_from_the_disk_until_a_file_changes(tmp_path):
    """Each process has the kernel of a throw-away module, and cache.py in a folder with another file.

    Only a kernel's first call goes through Python, also of one from the disk: 0.1 ms would be lost in each other call.
    """
    (tmp_path / "kernels.py").write_text(KERNELS)
    copy, other = tmp_path / "engine" / FILE.name, tmp_path / "engine" / "inlined.py"
    copy.parent.mkdir()
    copy.write_bytes(FILE.read_bytes())
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    for change, dtype, hits in (
        (None, "float32", 0),
        (None, "float32", 1),
        (None, "float64", 0),  # another type is another kernel
        ("FACTOR = 2", "float32", 0),
        ("FACTOR = 3", "float32", 0),
        (None, "float32", 1),
    ):
        if change:
            other.write_text(change)
        command = [sys.executable, "-c", DRIVER, str(copy), dtype]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert (found["hits"], found["misses"], found["out"]) == (hits, 1 - hits, [1, 3, 5]), (change, dtype)
        assert [name for name in found["python calls"] if name != "kernel"] == ["probe"]  # numba may report the kernel


def _drive(tmp_path, dtype="float32", first=""):
    """Run the kernel in a process of its own; what it prints, and stderr."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", first + DRIVER, str(FILE), dtype]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["out"] == [1, 3, 5]
    return found["hits"], done.stderr


def test_a_full_disk_costs_the_cache_alone(tmp_path):
    pytest.importorskip("resource")
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
    for _ in range(2):
        hits, said = _drive(tmp_path, first=full)
        assert hits == 0
        assert said.count(str(tmp_path / "cache")) == said.count("NUMBA_CACHE_DIR to another folder") == 1
    assert [_drive(tmp_path) for _ in range(2)] == [(0, ""), (1, "")]  # with space, as the message says


def test_a_damaged_cache_is_made_again(tmp_path):
    for dtype in ("float32", "float64"):
        _drive(tmp_path, dtype)
    index, first, second = sorted(
        (tmp_path / "cache").rglob("*.nb?"), key=lambda file: (file.suffix != ".nbi", file.name)
    )
    whole, kernel, other = (file.read_bytes() for file in (index, first, second))
    assert whole != kernel != other
    for file, damaged in (
        (index, whole[: len(whole) // 2]),
        (index, b""),
        (first, kernel[:1000]),
        (first, other),  # the disk was full between index and kernel
    ):
        file.write_bytes(damaged)
        assert [_drive(tmp_path) for _ in range(2)] == [(0, ""), (1, "")]


def test_sources_are_all_files_of_the_engines():
    files = [file for folder in FILE.parents[:3] for file in sorted(folder.glob("*.py"))]
    assert {"engine.py", "simd.py", "contract.py", "sh.py"} < {file.name for file in files}
    assert crc32(b"".join(file.read_bytes() for file in files)) == numba_cache.SOURCES


def test_another_numba_costs_the_cache_alone(monkeypatch):
    """The checksum goes into a private attribute: without it, no kernel of older sources may be taken from the disk."""
    njit = numba_cache.njit

    def other(*, cache=False, **options):
        def decorate(function):
            kernel = njit(**options)(function)
            return SimpleNamespace(py_func=function) if cache else kernel

        return decorate

    monkeypatch.setattr(numba_cache, "njit", other)
    double = numba_cache.cached_njit(nogil=True)(lambda x: 2 * x)
    assert double(21) == 42
    assert double.stats.cache_path is None


def test_without_a_place_to_write_to_it_is_compiled_in_memory():
    """Numba knows no place for code that comes from no file."""
    names = {}
    exec(compile("def double(x):\n    return 2 * x", "<nowhere>", "exec"), names)
    double = numba_cache.cached_njit()(names["double"])
    assert double(21) == 42
    assert double.stats.cache_path is None


def test_no_kernel_goes_around():
    """Numba's own cache would miss a change of a file that is inlined."""
    files = [path for path in sorted(FILE.parent.glob("*.py")) if path != FILE]
    assert len(files) > 10
    assert [path.name for path in files if "cache=True" in path.read_text()] == []


SORT = """
import numpy as np
from numba import njit
from kfgs._notes import hear
from kfgs.splat.engines.cpu.tiles_kernels import list_rows

made = {}
exec("def double(x): return 2 * x", made)  # a function of no module
with hear(print):
    for kind in (np.int32, np.int64):  # two compilations, one line
        njit(made["double"])(kind(1))
        list_rows(*np.zeros((4, 1), kind))
"""


def test_the_first_process_says_that_it_compiles(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    said = [
        subprocess.run([sys.executable, "-c", SORT], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert said == [f"{numba_cache.COMPILING}\n", ""]


COMMAND = """
import sys
import numpy as np
from kfgs import cli

def sort():
    "Sort."
    from kfgs.splat.engines.cpu.tiles_kernels import list_rows
    list_rows(*np.zeros((4, 1), np.int64))
    print("sorted")

cli.COMMANDS["sort"] = sort
sys.exit(cli.main(["sort"]))
"""


def test_every_command_says_on_stderr_that_it_compiles(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    ran = [
        subprocess.run([sys.executable, "-c", COMMAND], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    line = f"note: {numba_cache.COMPILING}\n"
    assert [(done.stdout, done.stderr) for done in ran] == [("sorted\n", line), ("sorted\n", "")]
