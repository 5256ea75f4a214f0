"""Vectors in compiled code, against numpy, and that the machine code is really as wide."""

import ctypes
import mmap
import os
import re
import sys

import numpy as np
import pytest

numba = pytest.importorskip("numba")

from llvmlite import binding  # noqa: E402

from kfgs.splat.engines.cpu.simd import (  # noqa: E402
    LANES,
    exp2,
    fma,
    lanes_below,
    load,
    load_part,
    reciprocal,
    store,
    store_part,
)

every_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])

CANARY = -77.0


def _random(dtype, *shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(dtype)


# memory ---------------------------------------------------------------------------------------------------------------


@numba.njit
def _copy_part(x, i, out, j, count):
    lanes = lanes_below(x, count)
    store_part(out, j, lanes, load_part(x, i, lanes))


@numba.njit
def _read_part(x, i, count, out):
    store(out, 0, load_part(x, i, lanes_below(x, count)))


@every_dtype
@pytest.mark.parametrize("count", [-3, 0, 1, 7, 15, 16, 40])
def test_parts_touch_nothing_but_the_mask(dtype, count):
    part = min(max(count, 0), LANES)
    room, x = np.full(LANES + 8, CANARY, dtype), _random(dtype, LANES)
    out = room[3 : 3 + part]  # in the midst of canaries
    _copy_part(x[:part], 0, out, 0, count)
    np.testing.assert_array_equal(out, x[:part])
    assert (np.delete(room, slice(3, 3 + part)) == CANARY).all()
    whole = np.full(LANES, CANARY, dtype)
    _read_part(x, 0, count, whole)
    np.testing.assert_array_equal(whole, np.where(np.arange(LANES) < part, x, 0))


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page as Linux does")
@every_dtype
def test_parts_may_end_where_memory_ends(dtype):
    """The page behind may not be touched: in a child, because it would not survive."""
    _copy_part(np.zeros(LANES, dtype), 0, np.zeros(LANES, dtype), 0, LANES)  # compiled before the fork
    page = mmap.PAGESIZE
    pages = mmap.mmap(-1, 2 * page)
    values = np.frombuffer(pages, dtype)
    assert ctypes.CDLL(None, use_errno=True).mprotect(ctypes.c_void_p(values.ctypes.data + page), page, 0) == 0
    last = values[: page // values.itemsize]
    child = os.fork()
    if child == 0:
        for count in range(LANES):
            _copy_part(last, len(last) - count, last, len(last) - count, count)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


# functions of one vector ----------------------------------------------------------------------------------------------


@numba.njit
def _powers(x, out):
    for i in range(0, len(x), LANES):
        store(out, i, exp2(load(x, i)))


@numba.njit
def _reciprocals(x, out):
    for i in range(0, len(x), LANES):
        store(out, i, reciprocal(load(x, i)))


def _largest_error(function, exact, x):
    """Relative to the exact value, in extended precision."""
    x = np.concatenate([x, np.full(-len(x) % LANES, x[-1])])
    out = np.full_like(x, CANARY)
    function(x, out)
    return np.abs(out / exact(x.astype(np.longdouble)) - 1).max()


@pytest.mark.parametrize(("dtype", "largest"), [(np.float32, 2e-7), (np.float64, 4e-16)])
def test_exp2_keeps_its_stated_error(dtype, largest):
    halves = np.arange(-251, 252) / 2
    near = np.concatenate([np.nextafter(halves.astype(dtype), dtype(way)) for way in (-1000, 1000)])
    x = np.concatenate([np.random.default_rng(0).uniform(-125.9, 125.9, 400_000), halves, near]).astype(dtype)
    assert _largest_error(_powers, np.exp2, x) <= largest


@every_dtype
def test_exp2_of_whole_numbers_is_exact(dtype):
    assert _largest_error(_powers, np.exp2, np.arange(-126, 127).astype(dtype)) == 0


@pytest.mark.parametrize(("dtype", "largest"), [(np.float32, 2e-7), (np.float64, 2.3e-16)])
def test_reciprocal_keeps_its_stated_error(dtype, largest):
    x = np.concatenate([10 ** np.random.default_rng(0).uniform(-3, 3, 400_000), [0.001, 0.01, 0.5, 1, 2, 1000]])
    assert _largest_error(_reciprocals, lambda v: 1 / v, x.astype(dtype)) <= largest


# machine code ---------------------------------------------------------------------------------------------------------


def _registers():
    """The name of the processor's widest vector registers."""
    features = binding.get_host_cpu_features()
    if numba.config.CPU_NAME or numba.config.CPU_FEATURES:
        pytest.skip("numba is told to compile for another processor than this one")
    if features.get("avx512f"):
        return "zmm"
    if features.get("avx2") and features.get("fma"):
        return "ymm"
    return pytest.skip("reads the assembly of x86-64 with AVX2 and FMA, which this processor lacks")


def _count_wide(kernel, registers):
    """Fused multiply-adds on whole registers of single numbers in the kernel's code."""
    (assembly,) = kernel.inspect_asm().values()
    return len(re.findall(rf"\bvfn?m(?:add|sub)\d+ps\b[^\n]*%{registers}", assembly))


@numba.njit
def _polynomial(x, out):
    for i in range(0, len(x), LANES):
        a = load(x, i)
        store(out, i, fma(fma(a, a, 1), a, 2))


def test_a_vector_is_a_register():
    registers = _registers()
    x, out = _random(np.float32, 4 * LANES), np.empty(4 * LANES, np.float32)
    _polynomial(x, out)
    np.testing.assert_allclose(out, (x * x + 1) * x + 2, rtol=1e-5)
    assert _count_wide(_polynomial, registers) >= 2
    (assembly,) = _polynomial.inspect_asm().values()
    assert not re.search(r"\bvfmadd\d+ss\b", assembly), "some numbers are computed one by one"
