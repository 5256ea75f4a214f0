"""Kernels on disk: taken from there when nothing has changed, compiled anew otherwise, and quick to call."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from zlib import crc32

import numpy as np
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
def scale(x):
    return {factor} * x


def decorate(compiled):
    @compiled(nogil=True)
    def kernel(pair, out):
        for i in range(len(out)):
            out[i] = scale(pair.left[i]) + pair.right[i]

    return kernel
"""

DRIVER = """
import importlib.util, json, sys
import numpy as np
from numba.core.dispatcher import Dispatcher

file, stamp, calls, dtype = sys.argv[1:]
spec = importlib.util.spec_from_file_location("numba_cache", file)
numba_cache = importlib.util.module_from_spec(spec)
spec.loader.exec_module(numba_cache)
if stamp != "own":
    numba_cache.SOURCES = int(stamp)
import kernels

in_python = []
compile_for_args = Dispatcher._compile_for_args


def count(self, *args, **kws):
    in_python.append(self.__name__)
    return compile_for_args(self, *args, **kws)


Dispatcher._compile_for_args = count
kernel = kernels.decorate(numba_cache.compiled)
pair, out = kernels.Pair(np.arange(3, dtype=dtype), np.ones(3, dtype)), np.zeros(3, dtype)
for _ in range(int(calls)):
    kernel(pair, out)
print(json.dumps({
    "out": out.tolist(),
    "hits": sum(kernel.stats.cache_hits.values()),
    "misses": sum(kernel.stats.cache_misses.values()),
    "in python": in_python.count("kernel"),
}))
"""


@pytest.fixture
def run(tmp_path):
    """Runs a kernel of a throw-away module in a process of its own, with a cache of its own."""
    (tmp_path / "cache").mkdir()

    def start(stamp="own", *, file=FILE, factor=2, calls=1, dtype="float32", environment=None):
        kernels = tmp_path / "kernels.py"
        text = KERNELS.format(factor=factor)
        if not kernels.exists() or kernels.read_text() != text:
            kernels.write_text(text)
        environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)} | (environment or {})
        command = [sys.executable, "-c", DRIVER, str(file), str(stamp), str(calls), dtype]
        done = subprocess.run(
            command, env={**os.environ, **environment}, capture_output=True, text=True, check=True, timeout=120
        )
        return json.loads(done.stdout)

    return start


def test_second_process_takes_the_kernel_from_the_cache(run):
    first = run()
    assert (first["hits"], first["misses"]) == (0, 1)
    second = run()
    assert (second["hits"], second["misses"]) == (1, 0)
    assert first["out"] == second["out"] == [1, 3, 5]
    other = run(dtype="float64")  # another type is another kernel, in the same place
    assert (other["hits"], other["misses"]) == (0, 1)
    again = run()
    assert (again["hits"], again["misses"]) == (1, 0)


def test_kernel_is_compiled_anew_when_the_sources_change(run):
    for stamp, hits in ((1, 0), (1, 1), (2, 0), (2, 1), (1, 0)):
        found = run(stamp)
        assert (found["hits"], found["misses"]) == (hits, 1 - hits), f"sources {stamp}"
        assert found["out"] == [1, 3, 5]


def test_calls_of_a_kernel_from_the_cache_are_resolved_in_c(run):
    """Only the first call goes through Python: it looks into the cache. Each other one would cost a tenth of a ms."""
    compiled = run(calls=20)
    cached = run(calls=20)
    assert (cached["hits"], cached["misses"]) == (1, 0)
    assert compiled["in python"] == cached["in python"] == 1


def _load(file):
    spec = importlib.util.spec_from_file_location("copied_numba_cache", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_sources_are_all_files_of_the_engines(tmp_path):
    files = [*sorted(FILE.parent.glob("*.py")), *sorted(FILE.parent.parent.glob("*.py"))]
    assert {"engine.py", "simd.py", "contract.py"} < {file.name for file in files}
    assert crc32(b"".join(file.read_bytes() for file in files)) == numba_cache.SOURCES
    copy = tmp_path / FILE.name
    copy.write_bytes(FILE.read_bytes())
    stamps = [_load(copy).SOURCES]
    other = tmp_path / "other.py"
    for text in ("x = 1", "x = 2"):
        other.write_text(text)
        stamps.append(_load(copy).SOURCES)
    assert len(set(stamps)) == 3
    os.utime(other, (1, 1))  # a copy or a checkout changes times, not contents
    assert stamps[-1] == _load(copy).SOURCES


def test_a_change_of_another_file_compiles_anew(run, tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    copy = package / FILE.name
    copy.write_bytes(FILE.read_bytes())
    assert run(file=copy)["misses"] == 1
    assert run(file=copy)["hits"] == 1
    (package / "inlined.py").write_text("FACTOR = 2")
    assert run(file=copy)["misses"] == 1


def test_without_a_place_to_write_to_it_is_compiled_in_memory(monkeypatch):
    asked = []
    njit = numba_cache.njit

    def refuse(**options):
        asked.append(options)
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba_cache, "njit", refuse)

    @numba_cache.compiled(nogil=True)
    def double(x, out):
        out[:] = 2 * x

    out = np.empty(3)
    double(np.arange(3.0), out)
    assert out.tolist() == [0, 2, 4]
    assert asked == [{"cache": True, "nogil": True}, {"nogil": True}]


def test_another_numba_costs_the_cache_alone(monkeypatch):
    """The stamp is a private attribute: where it is not, no kernel of older sources may be taken from the disk."""
    njit = numba_cache.njit

    def other(*, cache=False, **options):
        def decorate(function):
            kernel = njit(**options)(function)
            return SimpleNamespace(py_func=function) if cache else kernel

        return decorate

    monkeypatch.setattr(numba_cache, "njit", other)
    double = numba_cache.compiled(nogil=True)(lambda x: 2 * x)
    assert double(21) == 42
    assert double.stats.cache_path is None


def test_function_of_no_file_is_compiled_in_memory():
    """What numba itself says where there is no place: it knows none for this code."""
    names = {}
    exec(compile("def double(x):\n    return 2 * x", "<nowhere>", "exec"), names)
    double = numba_cache.compiled()(names["double"])
    assert double(21) == 42
    assert double.stats.cache_path is None


def test_options_are_passed_on():
    @numba_cache.compiled(nogil=True, error_model="numpy")
    def divide(x, y):
        return x / y

    assert divide.targetoptions["nogil"] is True
    assert divide.targetoptions["error_model"] == "numpy"
    assert np.isinf(divide(1.0, 0.0))


def test_no_kernel_goes_around():
    """Numba's own cache would miss a change of a file that is inlined."""
    files = [path for path in sorted(FILE.parent.glob("*.py")) if path != FILE]
    assert len(files) > 10
    assert [path.name for path in files if "cache=True" in path.read_text()] == []
