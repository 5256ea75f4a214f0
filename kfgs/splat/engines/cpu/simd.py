"""Vectors of LANES numbers as values inside numba's compiled code: the one file that speaks LLVM.

A plain loop leaves it to the compiler whether several pixels are computed at once; with a vector it is written down. LLVM
maps each operation to what the processor has: one register of AVX-512, two of AVX2, four of SSE or NEON.

    x = load(array, i)                      array[i], ..., array[i + LANES - 1]
    fma(x, 2.0, y) * x - 1.0                numbers are broadcast
    select(x >= y, x, 0.0)                  comparisons give a Mask

Indices are not checked and do not wrap around: the caller must keep them inside the array. Arrays are
contiguous and one-dimensional, of float32 or float64, and the vector's element type is that of the array. No operation
is reordered or contracted, so the same expression gives the same bits wherever it stands.

Prefetching aside, an operation on vectors is a Python operator or a function of this file.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from functools import update_wrapper
from inspect import Signature
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from .cache import inner_njit

LANES = 16
"""Numbers per vector: a block of 4 x 4 pixels, and one AVX-512 register of float32."""

_I1, _I32, _I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
_ELEMENTS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}


class VectorType(types.Type):
    """LANES numbers of one floating-point type."""

    def __init__(self, element: Any) -> None:
        self.element = element
        super().__init__(name=f"vector{LANES}({element})")


class MaskType(types.Type):
    """LANES truth values."""

    def __init__(self) -> None:
        super().__init__(name=f"mask{LANES}")


_MASK = MaskType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: VectorType) -> None:
        super().__init__(manager, kind, _vector(kind.element))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: MaskType) -> None:
        super().__init__(manager, kind, ir.VectorType(_I1, LANES))


def _vector(element: Any) -> Any:
    return ir.VectorType(_ELEMENTS[element], LANES)


def _integers(element: Any) -> Any:
    """The vector type of integers that are as wide as the elements."""
    return ir.VectorType(_I32 if element == types.float32 else _I64, LANES)


def _constant(kind: Any, value: float) -> Any:
    return ir.Constant(kind, [value] * LANES)


def _number(element: Any, value: float) -> Any:
    """A constant vector; a float32 is rounded here, because LLVM takes no other."""
    return _constant(_vector(element), float(np.float32(value)) if element == types.float32 else float(value))


def _spread(builder: Any, value: Any) -> Any:
    kind = ir.VectorType(value.type, LANES)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), _constant(ir.VectorType(_I32, LANES), 0))


def _as_vectors(context: Any, builder: Any, kinds: Any, values: Any, element: Any) -> list[Any]:
    """Vectors and masks as they are, numbers in every lane."""
    return [
        value
        if isinstance(kind, VectorType | MaskType)
        else _spread(builder, context.cast(builder, value, kind, element))
        for kind, value in zip(kinds, values, strict=True)
    ]


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _pointers(context: Any, builder: Any, kind: Any, array: Any, index: Any, stride: Any, count: int) -> Iterator[Any]:
    """Of array[index], array[index + stride], ..."""
    pointer = _pointer(context, builder, kind, array, index)
    for _ in range(count):
        yield pointer
        pointer = builder.gep(pointer, [stride])


def _load(builder: Any, element: Any, pointer: Any) -> Any:
    return builder.load(builder.bitcast(pointer, _vector(element).as_pointer()), align=element.bitwidth // 8)


def _store(builder: Any, element: Any, vector: Any, pointer: Any) -> None:
    builder.store(vector, builder.bitcast(pointer, vector.type.as_pointer()), align=element.bitwidth // 8)


def _call(builder: Any, name: str, result: Any, *arguments: Any) -> Any:
    """Call an LLVM intrinsic."""
    function = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), arguments)


def _suffix(element: Any) -> str:
    return f"v{LANES}f{element.bitwidth}"


def _fma(builder: Any, element: Any, x: Any, y: Any, z: Any) -> Any:
    """X y + z: fused where the processor can, which is the same decision everywhere in a program."""
    return _call(builder, f"llvm.fmuladd.{_suffix(element)}", _vector(element), x, y, z)


def _shuffle(builder: Any, x: Any, y: Any, order: list[int]) -> Any:
    """Lanes of x (0 to LANES - 1) and y (LANES and up) in the given order."""
    return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(_I32, LANES), order))


def _common(*kinds: Any) -> Any:
    """The type of the vectors among the arguments; None where there is none, or what else comes is no number."""
    vectors = {kind for kind in kinds if isinstance(kind, VectorType)}
    numbers = all(isinstance(kind, VectorType | types.Number) for kind in kinds)
    return vectors.pop() if len(vectors) == 1 and numbers else None


def _of_array(*kinds: Any) -> Any:
    """The vector type of the array among the arguments."""
    return next(VectorType(kind.dtype) for kind in kinds if isinstance(kind, types.Array))


def _several_of_array(like: Any, array: Any, *rest: Any) -> Any:
    return types.UniTuple(VectorType(array.dtype), len(like))


def _operation(result: Any) -> Any:
    """A function of compiled code, written as what it lowers to: `lower(context, builder, kinds, *arguments)`.

    `result` gives the type of its value for the arguments' types `kinds`, or None for arguments that it does not take; or
    is that type. Integers come as 64-bit ones.
    """

    def decorate(lower: Any) -> Any:
        def define(typing: Any, *kinds: Any) -> Any:
            kinds = tuple(types.int64 if isinstance(kind, types.Integer) else kind for kind in kinds)
            kind = result if isinstance(result, types.Type) else result(*kinds)

            def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
                value = lower(context, builder, kinds, *args)
                return context.get_dummy_value() if value is None else value

            return kind and (kind(*kinds), generate)

        update_wrapper(define, lower)
        parameters = list(Signature.from_callable(lower).parameters.values())[2:]  # `kinds` stands for `typing`
        define.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        return intrinsic(define)

    return decorate


# Operators ------------------------------------------------------------------------------------------------------------


def _register(symbol: Any, method: str, *comparison: str) -> None:
    """Lower an operator of vectors and numbers, or of masks, to `builder.method(*comparison, x, y)`."""
    of_masks = method in ("and_", "or_")

    @infer_global(symbol)
    class _Template(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if of_masks:
                return signature(_MASK, *args) if args == (_MASK, _MASK) else None
            kind = _common(*args) if len(args) == 2 else None
            return kind and signature(_MASK if comparison else kind, *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element = None if of_masks else _common(*sig.args).element
        return getattr(builder, method)(*comparison, *_as_vectors(context, builder, sig.args, args, element))

    vectors = (VectorType, VectorType), (VectorType, types.Number), (types.Number, VectorType)
    for kinds in ((MaskType, MaskType),) if of_masks else vectors:
        lower_builtin(symbol, *kinds)(lower)


for _symbol, _lowered in {
    operator.add: ("fadd",),
    operator.sub: ("fsub",),
    operator.mul: ("fmul",),
    operator.truediv: ("fdiv",),
    operator.lt: ("fcmp_ordered", "<"),
    operator.le: ("fcmp_ordered", "<="),
    operator.gt: ("fcmp_ordered", ">"),
    operator.ge: ("fcmp_ordered", ">="),
    operator.and_: ("and_",),
    operator.or_: ("or_",),
}.items():
    _register(_symbol, *_lowered)


# Memory ---------------------------------------------------------------------------------------------------------------


@_operation(_of_array)
def load(context: Any, builder: Any, kinds: Any, array: Any, index: Any) -> Any:
    """The vector of array[index], ..., array[index + LANES - 1]."""
    return _load(builder, kinds[0].dtype, _pointer(context, builder, kinds[0], array, index))


@_operation(types.void)
def store(context: Any, builder: Any, kinds: Any, array: Any, index: Any, value: Any) -> None:
    """Write a vector, or a number LANES times, to array[index], ..., array[index + LANES - 1]."""
    (vector,) = _as_vectors(context, builder, kinds[2:], [value], kinds[0].dtype)
    _store(builder, kinds[0].dtype, vector, _pointer(context, builder, kinds[0], array, index))


@_operation(_of_array)
def load_part(context: Any, builder: Any, kinds: Any, array: Any, index: Any, mask: Any) -> Any:
    """array[index + i] in the lanes i of the mask; 0 in the others, where nothing is read."""
    zero, size = _number(kinds[0].dtype, 0.0), ir.Constant(_I32, kinds[0].dtype.bitwidth // 8)
    place = builder.bitcast(_pointer(context, builder, kinds[0], array, index), zero.type.as_pointer())
    return _call(builder, f"llvm.masked.load.{_suffix(kinds[0].dtype)}.p0", zero.type, place, size, mask, zero)


@_operation(types.void)
def store_part(context: Any, builder: Any, kinds: Any, array: Any, index: Any, mask: Any, vector: Any) -> None:
    """Write the lanes i of the mask to array[index + i], and nothing else."""
    size = ir.Constant(_I32, kinds[0].dtype.bitwidth // 8)
    place = builder.bitcast(_pointer(context, builder, kinds[0], array, index), vector.type.as_pointer())
    _call(builder, f"llvm.masked.store.{_suffix(kinds[0].dtype)}.p0", ir.VoidType(), vector, place, size, mask)


@_operation(types.void)
def stream(context: Any, builder: Any, kinds: Any, array: Any, index: Any, vector: Any) -> None:
    """Write a vector to whole cache lines that are not needed soon: they are neither read before, nor kept in the cache."""
    place = builder.bitcast(_pointer(context, builder, kinds[0], array, index), vector.type.as_pointer())
    hint = builder.module.add_metadata([ir.Constant(_I32, 1)])
    builder.store(vector, place, align=64).set_metadata("nontemporal", hint)


@_operation(lambda array, index: array.dtype)
def fetch(context: Any, builder: Any, kinds: Any, array: Any, index: Any) -> Any:
    """array[index], without looking whether the index is negative."""
    return builder.load(_pointer(context, builder, kinds[0], array, index))


@_operation(types.void)
def put(context: Any, builder: Any, kinds: Any, array: Any, index: Any, value: Any) -> None:
    """array[index] = value, without looking whether the index is negative."""
    number = context.cast(builder, value, kinds[2], kinds[0].dtype)
    builder.store(number, _pointer(context, builder, kinds[0], array, index))


@_operation(types.void)
def prefetch(context: Any, builder: Any, kinds: Any, array: Any, index: Any) -> None:
    """Ask for the cache line of array[index]; any index is allowed."""
    pointer = builder.bitcast(_pointer(context, builder, kinds[0], array, index), ir.IntType(8).as_pointer())
    read, keep, data = (ir.Constant(_I32, number) for number in (0, 3, 1))
    _call(builder, "llvm.prefetch.p0", ir.VoidType(), pointer, read, keep, data)


# Arithmetic -----------------------------------------------------------------------------------------------------------


@_operation(lambda array, value: VectorType(array.dtype))
def spread(context: Any, builder: Any, kinds: Any, array: Any, value: Any) -> Any:
    """The number in every lane of a vector of the array's type."""
    return _as_vectors(context, builder, kinds[1:], [value], kinds[0].dtype)[0]


@_operation(_MASK)
def lanes_below(context: Any, builder: Any, kinds: Any, array: Any, count: Any) -> Any:
    """Mask of the first `count` lanes; the array is of any type."""
    return builder.icmp_signed(
        "<", ir.Constant(ir.VectorType(_I64, LANES), list(range(LANES))), _spread(builder, count)
    )


@_operation(_common)
def fma(context: Any, builder: Any, kinds: Any, x: Any, y: Any, z: Any) -> Any:
    """X y + z, rounded once where the processor has such an instruction."""
    element = _common(*kinds).element
    return _fma(builder, element, *_as_vectors(context, builder, kinds, (x, y, z), element))


def _choice(comparison: str) -> Any:
    @_operation(_common)
    def choose(context: Any, builder: Any, kinds: Any, x: Any, y: Any) -> Any:
        a, b = _as_vectors(context, builder, kinds, (x, y), _common(*kinds).element)
        return builder.select(builder.fcmp_ordered(comparison, a, b), a, b)

    return choose


minimum = _choice("<")  # of a NaN and a number: the second argument
maximum = _choice(">")


@_operation(lambda mask, x, y: _common(x, y))
def select(context: Any, builder: Any, kinds: Any, mask: Any, x: Any, y: Any) -> Any:
    """Lane by lane: x where the mask holds, else y."""
    return builder.select(mask, *_as_vectors(context, builder, kinds[1:], (x, y), _common(*kinds[1:]).element))


_EXP2 = {  # 2^f = 1 + c1 f + c2 f^2 + ... on |f| <= 1/2
    # fitted to the least largest relative error, 9.2e-8
    types.float32: (
        1.0,
        0.6931469775991606,
        0.24022242085274195,
        0.055507337432728926,
        0.00967151264428348,
        0.001326472718947771,
    ),
    # the exponential series in f ln 2, whose next term is 4e-18
    types.float64: tuple(math.log(2) ** k / math.factorial(k) for k in range(14)),
}


@_operation(_common)
def exp2(context: Any, builder: Any, kinds: Any, x: Any) -> Any:
    """2^x for |x| < 126, with a relative error below 2e-7 (float64: 4e-16); any number for other x.

    With n = round(x), 2^x = 2^n 2^(x - n): a polynomial, and n added to the exponent's bits.
    """
    element = kinds[0].element
    mantissa, integers = 23 if element == types.float32 else 52, _integers(element)
    rounder = _number(element, 1.5 * 2**mantissa)  # adding it leaves round(x) in the lowest bits
    shifted = builder.fadd(x, rounder)
    f = builder.fsub(x, builder.fsub(shifted, rounder))
    power = _number(element, _EXP2[element][-1])
    for coefficient in _EXP2[element][-2::-1]:
        power = _fma(builder, element, power, f, _number(element, coefficient))
    exponent = builder.shl(builder.bitcast(shifted, integers), _constant(integers, mantissa))
    return builder.bitcast(builder.add(builder.bitcast(power, integers), exponent), x.type)


@_operation(_common)
def reciprocal(context: Any, builder: Any, kinds: Any, x: Any) -> Any:
    """1 / x for x in [0.001, 1000], with a relative error below 2e-7; exactly rounded for float64.

    Newton's iteration doubles the correct bits of a first guess read off the exponent: cheaper than a division.
    """
    element = kinds[0].element
    if element == types.float64:
        return builder.fdiv(_number(element, 1.0), x)
    integers = _integers(element)
    guess = builder.bitcast(builder.sub(_constant(integers, 0x7EF311C3), builder.bitcast(x, integers)), x.type)
    minus_x = builder.fsub(_number(element, -0.0), x)
    for _ in range(3):
        guess = builder.fmul(guess, _fma(builder, element, minus_x, guess, _number(element, 2.0)))
    return guess


# Across the lanes -----------------------------------------------------------------------------------------------------


@_operation(types.uint32)
def bits(context: Any, builder: Any, kinds: Any, mask: Any) -> Any:
    """The mask as a number: bit i is lane i."""
    return builder.zext(builder.bitcast(mask, ir.IntType(LANES)), _I32)


@inner_njit(forceinline=True)
def any_of(mask: Any) -> bool:
    """Whether some lane of the mask holds."""
    return bits(mask) != 0  # type: ignore[no-any-return]


@_operation(types.int64)
def trailing_zeros(context: Any, builder: Any, kinds: Any, number: Any) -> Any:
    """Position of the lowest bit that is set; the number is not 0."""
    return builder.cttz(number, ir.Constant(_I1, 1))


@_operation(lambda x: x.element)
def sum_lanes(context: Any, builder: Any, kinds: Any, x: Any) -> Any:
    """The sum of a vector's numbers: pairs half a vector apart first."""
    width = LANES
    while width > 1:
        width //= 2
        x = builder.fadd(x, _shuffle(builder, x, x, [(i + width) % LANES for i in range(LANES)]))
    return builder.extract_element(x, ir.Constant(_I32, 0))


@_operation(lambda vectors: vectors.dtype)
def sum_many(context: Any, builder: Any, kinds: Any, vectors: Any) -> Any:
    """Vector whose lane i is the sum of the i-th of up to LANES vectors; 0 in the lanes beyond.

    Neighbours are added pairwise, then pairs, and so on, each time with half of the lanes of both: about 4 operations
    per sum, where one sum after another would take 8.
    """
    rows = cgutils.unpack_tuple(builder, vectors)
    rows += [_number(kinds[0].dtype.element, 0.0)] * (LANES - len(rows))
    step = 1
    while len(rows) > 1:  # lanes with the bit `step` set come from the second vector
        kept = [i if not i & step else LANES + (i ^ step) for i in range(LANES)]
        other = [i ^ step if not i & step else LANES + i for i in range(LANES)]
        pairs = zip(rows[::2], rows[1::2], strict=True)
        rows = [builder.fadd(_shuffle(builder, x, y, kept), _shuffle(builder, x, y, other)) for x, y in pairs]
        step *= 2
    return rows[0]


@_operation(lambda rows: rows)
def transpose(context: Any, builder: Any, kinds: Any, rows: Any) -> Any:
    """LANES vectors, lane j of the i-th from lane i of the j-th."""
    vectors, step = cgutils.unpack_tuple(builder, rows), 1
    while step < LANES:  # swap the off-diagonal squares of side `step`
        upper = [i if not i & step else LANES + i - step for i in range(LANES)]
        lower = [i + step if not i & step else LANES + i for i in range(LANES)]
        for i in range(LANES):
            if not i & step:
                x, y = vectors[i], vectors[i + step]
                vectors[i], vectors[i + step] = _shuffle(builder, x, y, upper), _shuffle(builder, x, y, lower)
        step *= 2
    return context.make_tuple(builder, kinds[0], vectors)


@_operation(lambda rows: rows)
def regroup(context: Any, builder: Any, kinds: Any, rows: Any) -> Any:
    """Four vectors of four quarters each: quarter j of the i-th comes from quarter i of the j-th."""
    a, b, c, d = cgutils.unpack_tuple(builder, rows)
    quarter, half, vectors = LANES // 4, LANES // 2, []
    for i in range(4):
        mine = list(range(i * quarter, (i + 1) * quarter))
        pair = mine + [LANES + lane for lane in mine]
        left, right = _shuffle(builder, a, b, pair * 2), _shuffle(builder, c, d, pair * 2)
        vectors.append(_shuffle(builder, left, right, [*range(half), *range(LANES + half, 2 * LANES)]))
    return context.make_tuple(builder, kinds[0], vectors)


# Several vectors in registers: tuples whose length is known when compiling ---------------------------------------------


@_operation(_several_of_array)
def load_many(context: Any, builder: Any, kinds: Any, like: Any, array: Any, index: Any, stride: Any) -> Any:
    """As many vectors as the tuple `like` is long, the k-th from array[index + k stride]."""
    pointers = _pointers(context, builder, kinds[1], array, index, stride, len(kinds[0]))
    vectors = [_load(builder, kinds[1].dtype, pointer) for pointer in pointers]
    return context.make_tuple(builder, _several_of_array(*kinds), vectors)


@_operation(types.void)
def store_many(context: Any, builder: Any, kinds: Any, array: Any, index: Any, stride: Any, vectors: Any) -> None:
    """Write the k-th vector to array[index + k stride]."""
    pointers = _pointers(context, builder, kinds[0], array, index, stride, len(kinds[3]))
    for vector, pointer in zip(cgutils.unpack_tuple(builder, vectors), pointers, strict=True):
        _store(builder, kinds[0].dtype, vector, pointer)


@_operation(_several_of_array)
def spread_many(context: Any, builder: Any, kinds: Any, like: Any, array: Any, index: Any, stride: Any) -> Any:
    """As many vectors as the tuple `like` is long, the k-th full of array[index + k stride]."""
    pointers = _pointers(context, builder, kinds[1], array, index, stride, len(kinds[0]))
    vectors = [_spread(builder, builder.load(pointer)) for pointer in pointers]
    return context.make_tuple(builder, _several_of_array(*kinds), vectors)


@_operation(_several_of_array)
def zero_many(context: Any, builder: Any, kinds: Any, like: Any, array: Any) -> Any:
    """As many vectors of zeros of the array's type as the tuple `like` is long."""
    zeros = [_number(kinds[1].dtype, 0.0)] * len(kinds[0])
    return context.make_tuple(builder, _several_of_array(*kinds), zeros)


@_operation(lambda sums, left, right: sums)
def add_outer(context: Any, builder: Any, kinds: Any, sums: Any, left: Any, right: Any) -> Any:
    """sums[i n + j] + left[i] * right[j], with n = len(right)."""
    element, n = kinds[0].dtype.element, len(kinds[2])
    totals, x, y = (cgutils.unpack_tuple(builder, value) for value in (sums, left, right))
    added = [_fma(builder, element, x[k // n], y[k % n], total) for k, total in enumerate(totals)]
    return context.make_tuple(builder, kinds[0], added)


@_operation(lambda start, left, right: start)
def add_dot(context: Any, builder: Any, kinds: Any, start: Any, left: Any, right: Any) -> Any:
    """Start + left[0] right[0] + left[1] right[1] + ..., one after another."""
    for x, y in zip(*(cgutils.unpack_tuple(builder, value) for value in (left, right)), strict=True):
        start = _fma(builder, kinds[0].element, x, y, start)
    return start
