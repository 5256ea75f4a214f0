"""Vectors in compiled code, against numpy, and that the machine code is really as wide."""

import ctypes
import mmap
import os
import re
import sys

import numpy as np
import pytest
import torch
from cases_splat import random_splats

numba = pytest.importorskip("numba")

from llvmlite import binding  # noqa: E402

from kfgs.splat import bin_tiles, composite  # noqa: E402
from kfgs.splat.engines.cpu import engine as numba_cpu  # noqa: E402
from kfgs.splat.engines.cpu import square as numba_square  # noqa: E402
from kfgs.splat.engines.cpu.simd import (  # noqa: E402
    LANES,
    bits,
    exp2,
    fetch,
    fma,
    lanes_below,
    load,
    load_part,
    maximum,
    minimum,
    reciprocal,
    select,
    store,
    store_part,
)

every_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])

CANARY = -77.0


def _random(dtype, *shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(dtype)


def _whole(dtype, *shape, seed=0):
    """Small whole numbers: their sums and products are exact in any order."""
    return np.random.default_rng(seed).integers(-9, 10, shape).astype(dtype)


# operators ------------------------------------------------------------------------------------------------------------


@numba.njit
def _arithmetic(x, y, out):
    a, b = load(x, 0), load(y, 0)
    store(out, 0 * LANES, a + b)
    store(out, 1 * LANES, a - b)
    store(out, 2 * LANES, a * b)
    store(out, 3 * LANES, a / b)
    store(out, 4 * LANES, a + 0.1)
    store(out, 5 * LANES, 0.1 + a)
    store(out, 6 * LANES, a - 3)
    store(out, 7 * LANES, 3 - a)
    store(out, 8 * LANES, a * fetch(y, 2))
    store(out, 9 * LANES, fetch(y, 2) * a)
    store(out, 10 * LANES, a / 0.1)
    store(out, 11 * LANES, 1 / b)


@every_dtype
def test_arithmetic_is_that_of_numpy_to_the_bit(dtype):
    x, y, out = _random(dtype, LANES), _random(dtype, LANES, seed=1), np.empty(12 * LANES, dtype)
    _arithmetic(x, y, out)
    tenth, three, one = dtype(0.1), dtype(3), dtype(1)
    expected = [x + y, x - y, x * y, x / y, x + tenth, tenth + x, x - three, three - x]
    expected += [x * y[2], y[2] * x, x / tenth, one / y]
    np.testing.assert_array_equal(out.reshape(12, LANES), expected)


@numba.njit
def _choices(x, y, out, masks):
    a, b = load(x, 0), load(y, 0)
    store(out, 0 * LANES, minimum(a, b))
    store(out, 1 * LANES, maximum(a, b))
    store(out, 2 * LANES, minimum(a, 0.1))
    store(out, 3 * LANES, minimum(0.1, a))
    store(out, 4 * LANES, maximum(a, 0))
    store(out, 5 * LANES, maximum(0, a))
    store(out, 6 * LANES, select(a < b, a, b))
    store(out, 7 * LANES, select(a < b, 0.1, b))
    store(out, 8 * LANES, select(a < b, a, 2))
    for i, mask in enumerate(
        (a < b, a <= b, a > b, a >= b, a < 0, a > 0, a <= 0, a > 0, a >= 0, (a < b) & (a > 0), (a < b) | (a > 0))
    ):
        masks[i] = bits(mask)


def _as_bits(mask):
    return sum(1 << i for i, holds in enumerate(mask) if holds)


@every_dtype
def test_comparisons_and_choices(dtype):
    x, y = _whole(dtype, LANES), _whole(dtype, LANES, seed=1)
    x[:3], y[:3] = (4, 0, -0.0), (4, 0, 0)  # equal ones
    out, masks = np.empty(9 * LANES, dtype), np.zeros(11, np.uint32)
    _choices(x, y, out, masks)
    tenth = dtype(0.1)
    expected = [np.minimum(x, y), np.maximum(x, y), np.minimum(x, tenth), np.minimum(x, tenth)]
    expected += [np.maximum(x, 0), np.maximum(x, 0)]
    expected += [np.where(x < y, x, y), np.where(x < y, tenth, y), np.where(x < y, x, 2)]
    np.testing.assert_array_equal(out.reshape(9, LANES), expected)
    truths = [x < y, x <= y, x > y, x >= y, x < 0, x > 0, x <= 0, x > 0, x >= 0, (x < y) & (x > 0), (x < y) | (x > 0)]
    assert masks.tolist() == [_as_bits(truth) for truth in truths]


@every_dtype
def test_nan_compares_false_and_gives_the_second_argument(dtype):
    nan = dtype("nan")
    x, y = np.full(LANES, nan), _whole(dtype, LANES)
    out, masks = np.empty(9 * LANES, dtype), np.zeros(11, np.uint32)
    _choices(x, y, out, masks)
    tenth = np.full(LANES, dtype(0.1))
    expected = [y, y, tenth, x, 0 * tenth, x, y, y, np.full(LANES, 2)]
    np.testing.assert_array_equal(out.reshape(9, LANES), expected)
    assert not masks.any()
    _choices(y, x, out, masks)
    np.testing.assert_array_equal(out.reshape(9, LANES)[:2], [x, x])
    assert not masks[:4].any()


@numba.njit
def _fused(x, y, z, out):
    a, b, c = load(x, 0), load(y, 0), load(z, 0)
    store(out, 0 * LANES, fma(a, b, c))
    store(out, 1 * LANES, fma(a, 3, c))
    store(out, 2 * LANES, fma(3, a, -1.5))


@every_dtype
def test_fma(dtype):
    x, y, z = (_random(dtype, LANES, seed=seed) for seed in range(3))
    eps = np.finfo(dtype).eps
    x[0], y[0], z[0] = 1 + eps, 1 - eps, -1  # the product is 1 - eps^2, which rounds to 1
    out = np.empty(3 * LANES, dtype)
    _fused(x, y, z, out)
    exact = [x.astype(np.longdouble) * y + z, x.astype(np.longdouble) * 3 + z, x.astype(np.longdouble) * 3 - 1.5]
    size = np.abs(x * y) + np.abs(z) + np.abs(3 * x) + 1.5
    assert (np.abs(out.reshape(3, LANES) - np.array(exact)) <= eps * size).all()
    assert out[0] in (-(eps**2), 0)
    if binding.get_host_cpu_features().get("fma"):
        assert out[0] == -(eps**2), "the processor rounds once, the code does not"


def test_vectors_of_two_types_do_not_mix():
    single, double = np.ones(LANES, np.float32), np.ones(LANES)
    for function in (
        lambda x, y: store(x, 0, load(x, 0) + load(y, 0)),
        lambda x, y: store(x, 0, minimum(load(x, 0), load(y, 0))),
    ):
        with pytest.raises(numba.core.errors.TypingError):
            numba.njit(function)(single, double)


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


@pytest.mark.parametrize("name", ["composite_band", "differentiate_band"])
def test_compositing_is_as_wide(name, monkeypatch):
    """Compiled anew, because no assembly is kept on disk."""
    registers = _registers()
    kernel = numba.njit(**numba_square.OPTIONS)(getattr(numba_cpu, name).py_func)
    monkeypatch.setattr(numba_cpu, name, kernel)
    projected, features = random_splats(20, 16, 16, seed=0, dtype=torch.float32)
    inputs = projected.means2d, projected.conics, projected.opacities, features.requires_grad_()
    maps, _ = composite(*inputs, bin_tiles(projected, 16, 16), engine="numba")
    maps.sum().backward()
    assert features.grad.abs().min() > 0
    assert _count_wide(kernel, registers) >= 10
