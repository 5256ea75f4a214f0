"""Kernels on disk: taken from there when nothing has changed, compiled again otherwise, and quick to call."""

import importlib.util
import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from forked import forks, in_fork

numba = pytest.importorskip("numba")

from kfgs.splat.engines.cpu import cache as numba_cache  # noqa: E402

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
    @cached_njit()
    def kernel(pair, out):
        for i in range(len(out)):
            out[i] = double(pair.left[i]) + pair.right[i]

    return kernel
"""


def load(file):
    spec = importlib.util.spec_from_file_location(file.stem, file)
    sys.modules[file.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def call(folder, dtype, file, full):
    """Call the kernel twice; how many came from the disk, which functions of Python the second call ran, and warnings."""
    numba.config.CACHE_DIR = str(folder / "cache")
    kernels = load(folder / "kernels.py")
    kernel = kernels.decorate(load(file).cached_njit)
    pair, out = kernels.Pair(np.arange(3, dtype=dtype), np.ones(3, dtype)), np.zeros(3, dtype)
    if full:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        kernel(pair, out)
    python_calls = []
    sys.setprofile(lambda frame, event, _: python_calls.append(frame.f_code.co_name) if event == "call" else None)
    kernel(pair, out)
    sys.setprofile(None)
    assert out.tolist() == [1, 3, 5]
    hits, misses = (sum(counts.values()) for counts in (kernel.stats.cache_hits, kernel.stats.cache_misses))
    assert hits + misses == 1
    return hits, python_calls, [str(warning.message) for warning in said]


@pytest.fixture
def run(tmp_path):
    """Calls the kernel of a throw-away module in a new process: the number of kernels from the disk, and warnings.

    Only a kernel's first call goes through Python, also of one from the disk: 0.1 ms would be lost in each other call.
    """
    (tmp_path / "kernels.py").write_text(KERNELS)

    def run(dtype="float32", file=FILE, full=False):
        hits, python_calls, said = in_fork(lambda: call(tmp_path, dtype, file, full))
        assert set(python_calls) <= {"kernel"}  # numba may report the kernel
        return hits, said

    return run


@forks
def test_a_kernel_is_taken_from_the_disk_until_a_file_changes(run, tmp_path):
    copy, other = tmp_path / "engine" / FILE.name, tmp_path / "engine" / "inlined.py"
    copy.parent.mkdir()
    copy.write_bytes(FILE.read_bytes())
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
        assert run(dtype, copy) == (hits, []), (change, dtype)


@forks
def test_a_full_disk_costs_the_cache_alone(run, tmp_path):
    for _ in range(2):
        hits, (said,) = run(full=True)
        assert hits == 0
        assert said.startswith(str(tmp_path / "cache"))
        assert "NUMBA_CACHE_DIR to another folder" in said
    assert [run(), run()] == [(0, []), (1, [])]  # with space, as the message says


@forks
def test_a_damaged_cache_is_made_again(run, tmp_path):
    for dtype in ("float32", "float64"):
        run(dtype)
    files = (tmp_path / "cache").rglob("*.nb?")
    index, first, second = sorted(files, key=lambda file: (file.suffix != ".nbi", file.name))
    whole, kernel, other = (file.read_bytes() for file in (index, first, second))
    assert whole != kernel != other
    for file, damaged in (
        (index, whole[: len(whole) // 2]),
        (index, b""),
        (first, kernel[:1000]),
        (first, other),  # the disk was full between index and kernel
    ):
        file.write_bytes(damaged)
        assert [run(), run()] == [(0, []), (1, [])]


def test_another_numba_costs_the_cache_alone(monkeypatch):
    """The checksum goes into a private attribute: without it, no kernel of older sources may be taken from the disk."""
    njit = numba_cache.njit

    def other(*, cache=False, **options):
        def decorate(function):
            kernel = njit(**options)(function)
            return SimpleNamespace(py_func=function) if cache else kernel

        return decorate

    monkeypatch.setattr(numba_cache, "njit", other)
    double = numba_cache.cached_njit()(lambda x: 2 * x)
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


COMMAND = """
import sys
import numpy as np
from kfgs import cli

def sort():
    "Sort."
    from kfgs.splat.engines.cpu.tiles_kernels import list_rows
    for kind in (np.int32, np.int64):
        list_rows(*np.zeros((4, 1), kind))
    print("sorted")

cli.COMMANDS["sort"] = sort
sys.exit(cli.main(["sort"]))
"""


def test_the_first_command_says_on_stderr_that_it_compiles(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", COMMAND]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("sorted\n", f"note: {numba_cache.COMPILING}\n")  # once, for two compilations
