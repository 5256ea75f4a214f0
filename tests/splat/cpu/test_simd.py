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
from kfgs.splat.engines.cpu import simd as numba_simd  # noqa: E402
from kfgs.splat.engines.cpu import square as numba_square  # noqa: E402
from kfgs.splat.engines.cpu.simd import (  # noqa: E402
    LANES,
    add_dot,
    add_outer,
    any_of,
    bits,
    exp2,
    fetch,
    fma,
    lanes_below,
    load,
    load_many,
    load_part,
    maximum,
    minimum,
    prefetch,
    put,
    reciprocal,
    regroup,
    select,
    spread,
    spread_many,
    store,
    store_many,
    store_part,
    sum_lanes,
    sum_many,
    trailing_zeros,
    transpose,
    zero_many,
)

every_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])

THREE, FOUR, SIX, SIXTEEN = (0,) * 3, (0,) * 4, (0,) * 6, (0,) * 16
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
def _copy(x, i, out, j):
    store(out, j, load(x, i))


@numba.njit
def _copy_part(x, i, out, j, count):
    lanes = lanes_below(x, count)
    store_part(out, j, lanes, load_part(x, i, lanes))


@numba.njit
def _read_part(x, i, count, out):
    store(out, 0, load_part(x, i, lanes_below(x, count)))


@every_dtype
@pytest.mark.parametrize(("i", "j"), [(0, 0), (3, 21), (7, 1)])
def test_load_and_store_move_a_vector_from_anywhere(dtype, i, j):
    x, out = _random(dtype, 3 * LANES), np.full(3 * LANES, CANARY, dtype)
    _copy(x, i, out, j)
    expected = np.full(3 * LANES, CANARY, dtype)
    expected[j : j + LANES] = x[i : i + LANES]
    np.testing.assert_array_equal(out, expected)


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


@numba.njit
def _scalars(x, integers, out):
    inside = x[4:]
    out[0] = fetch(inside, 1)
    out[1] = fetch(inside, -2)
    put(x, 9, 0.1)
    put(x[10:], -10, 7)
    put(integers, 1, np.uint32(0xFFFFFFFE))
    prefetch(x, 3)
    prefetch(x, -(1 << 40))
    prefetch(x, 1 << 40)
    store(out, 2, 2)
    store(out, 2 + LANES, spread(x, 0.1))


@every_dtype
def test_single_numbers(dtype):
    x, integers, out = _random(dtype, 16), np.zeros(3, np.int32), np.empty(2 + 2 * LANES, dtype)
    before = x.copy()
    _scalars(x, integers, out)
    assert out[:2].tolist() == before[[5, 2]].tolist()
    before[9], before[0] = 0.1, 7
    np.testing.assert_array_equal(x, before)
    assert integers.tolist() == [0, -2, 0]
    np.testing.assert_array_equal(out[2:], np.repeat(np.array([2, 0.1], dtype), LANES))


# masks ----------------------------------------------------------------------------------------------------------------


@numba.njit
def _masks(x, count):
    lanes = lanes_below(x, count)
    return bits(lanes), any_of(lanes)


@numba.njit
def _lowest(number):
    return trailing_zeros(np.uint32(number))


@pytest.mark.parametrize("count", [-100, -1, 0, 1, 2, 15, 16, 17, 1 << 40])
def test_lanes_below(count):
    holds = np.arange(LANES) < count
    for x in (np.zeros(1, np.float32), np.zeros(1)):
        assert _masks(x, count) == (_as_bits(holds), bool(holds.any()))


def test_trailing_zeros():
    numbers = [(1 << high) | (1 << low) for low in range(32) for high in range(low, 32)]
    assert [_lowest(number) for number in numbers] == [(number & -number).bit_length() - 1 for number in numbers]


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


# across the lanes -----------------------------------------------------------------------------------------------------


@numba.njit
def _across(x, out):
    store(out, 0, sum_lanes(load(x, LANES)))
    store_many(out, LANES, LANES, transpose(load_many(SIXTEEN, x, 0, LANES)))
    store_many(out, 17 * LANES, LANES, regroup(load_many(FOUR, x, 0, LANES)))


@every_dtype
def test_sum_transpose_and_regroup(dtype):
    x, out = np.arange(LANES * LANES).astype(dtype), np.empty(21 * LANES, dtype)
    _across(x, out)
    square = x.reshape(LANES, LANES)
    out = out.reshape(-1, LANES)
    assert (out[0] == square[1].sum()).all()
    np.testing.assert_array_equal(out[1:17], square.T)
    quarters = square[:4].reshape(4, 4, LANES // 4)
    np.testing.assert_array_equal(out[17:], quarters.swapaxes(0, 1).reshape(4, LANES))


@numba.njit
def _sums(like, x, out):
    store(out, 0, sum_many(load_many(like, x, 0, LANES)))


@pytest.mark.parametrize(
    ("dtype", "counts"),
    [(np.float32, range(1, LANES + 1)), (np.float64, (1, 2, 5, 10, LANES))],
    ids=["single", "double"],
)
def test_sums_of_several_vectors(dtype, counts):
    x, out = _whole(dtype, LANES, LANES), np.empty(LANES, dtype)
    for count in counts:
        _sums((0,) * count, x.ravel(), out)
        np.testing.assert_array_equal(out, np.where(np.arange(LANES) < count, x.sum(axis=1), 0), f"{count} vectors")


# several vectors ------------------------------------------------------------------------------------------------------


@numba.njit
def _move_many(x, i, from_stride, out, j, to_stride):
    store_many(out, j, to_stride, load_many(THREE, x, i, from_stride))


@numba.njit
def _spread_many(x, i, stride, out):
    store_many(out, 0, LANES, spread_many(THREE, x, i, stride))


@every_dtype
@pytest.mark.parametrize("stride", [1, 5, LANES, 3 * LANES, -4])
def test_several_vectors_are_moved_by_strides(dtype, stride):
    start = 2 * -min(stride, 0)
    x, out = _random(dtype, 200), np.full(200, CANARY, dtype)
    _move_many(x, start, stride, out, 7, LANES + 3)
    expected = np.full(200, CANARY, dtype)
    for k in range(3):
        expected[7 + k * (LANES + 3) :][:LANES] = x[start + k * stride :][:LANES]
    np.testing.assert_array_equal(out, expected)
    _spread_many(x, start, stride, out)
    np.testing.assert_array_equal(out[: 3 * LANES], np.repeat(x[[start + k * stride for k in range(3)]], LANES))


@numba.njit
def _products(x, y, z, out):
    left, right = load_many(THREE, x, 0, LANES), load_many(THREE, y, 0, LANES)
    pair = right[0], right[1]
    sums = load_many(SIX, z, 0, LANES)
    store_many(out, 0, LANES, add_outer(left, (load(z, 0),), right))
    store_many(out, 3 * LANES, LANES, add_outer(sums, left, pair))
    store(out, 9 * LANES, add_dot(load(z, 0), left, right))
    store_many(out, 10 * LANES, LANES, zero_many(THREE, x))


@every_dtype
def test_products_of_several_vectors(dtype):
    x, y, z = _whole(dtype, 3, LANES), _whole(dtype, 3, LANES, seed=1), _whole(dtype, 6, LANES, seed=2)
    out = np.full((13, LANES), CANARY, dtype)
    _products(x.ravel(), y.ravel(), z.ravel(), out.reshape(-1))
    np.testing.assert_array_equal(out[:3], x + z[0] * y)
    np.testing.assert_array_equal(out[3:9], z + np.array([x[i] * y[j] for i in range(3) for j in range(2)]))
    np.testing.assert_array_equal(out[9], z[0] + (x * y).sum(axis=0))
    assert not out[10:].any()


def test_every_operation_is_tested():
    own = {name for name, value in vars(numba_simd).items() if getattr(value, "__module__", "") == numba_simd.__name__}
    assert {name for name in own if not name.startswith("_") and not name.endswith("Type")} <= set(globals())


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
