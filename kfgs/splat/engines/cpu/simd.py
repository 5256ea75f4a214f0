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
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

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


def _as_vector(context: Any, builder: Any, value: Any, kind: Any, element: Any) -> Any:
    """The value itself if it is a vector or a mask, else the number in every lane."""
    if isinstance(kind, VectorType | MaskType):
        return value
    return _spread(builder, context.cast(builder, value, kind, element))


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _call(builder: Any, name: str, result: Any, *arguments: Any) -> Any:
    """Call an LLVM intrinsic."""
    function = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), arguments)


def _suffix(element: Any) -> str:
    return f"v{LANES}f{32 if element == types.float32 else 64}"


def _fma(builder: Any, element: Any, x: Any, y: Any, z: Any) -> Any:
    """X y + z: fused where the processor can, which is the same decision everywhere in a program."""
    return _call(builder, f"llvm.fmuladd.{_suffix(element)}", _vector(element), x, y, z)


def _element_of(kinds: tuple[Any, ...]) -> Any:
    """The element type of the vectors among the arguments; None where there is none, or what else comes is no number."""
    elements = {kind.element for kind in kinds if isinstance(kind, VectorType)}
    numbers = all(isinstance(kind, VectorType | types.Number) for kind in kinds)
    return elements.pop() if len(elements) == 1 and numbers else None


# Operators ------------------------------------------------------------------------------------------------------------


def _register(symbol: Any, method: str, *comparison: str) -> None:
    """Lower an operator of vectors and numbers, or of masks, to `builder.method(*comparison, x, y)`."""
    of_masks = method in ("and_", "or_")

    @infer_global(symbol)
    class _Template(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if of_masks:
                return signature(_MASK, *args) if args == (_MASK, _MASK) else None
            element = _element_of(args) if len(args) == 2 else None
            return element and signature(_MASK if comparison else VectorType(element), *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element = None if of_masks else _element_of(sig.args)
        x, y = (_as_vector(context, builder, *pair, element) for pair in zip(args, sig.args, strict=True))
        return getattr(builder, method)(*comparison, x, y)

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


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """The vector of array[index], ..., array[index + LANES - 1]."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], *args)
        return builder.load(
            builder.bitcast(pointer, _vector(array.dtype).as_pointer()), align=array.dtype.bitwidth // 8
        )

    return VectorType(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write a vector, or a number LANES times, to array[index], ..., array[index + LANES - 1]."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = _as_vector(context, builder, args[2], sig.args[2], array.dtype)
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(vector, builder.bitcast(pointer, vector.type.as_pointer()), align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def load_part(typing: Any, array: Any, index: Any, mask: Any) -> Any:
    """array[index + i] in the lanes i of the mask, which alone are read; 0 in the others."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        zero, size = _number(array.dtype, 0.0), ir.Constant(_I32, array.dtype.bitwidth // 8)
        place = builder.bitcast(_pointer(context, builder, array, args[0], args[1]), zero.type.as_pointer())
        name = f"llvm.masked.load.{_suffix(array.dtype)}.p0"
        return _call(builder, name, zero.type, place, size, args[2], zero)

    return VectorType(array.dtype)(array, types.intp, mask), generate


@intrinsic
def store_part(typing: Any, array: Any, index: Any, mask: Any, vector: Any) -> Any:
    """Write the lanes i of the mask to array[index + i], and nothing else."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        size = ir.Constant(_I32, array.dtype.bitwidth // 8)
        place = builder.bitcast(_pointer(context, builder, array, args[0], args[1]), args[3].type.as_pointer())
        name = f"llvm.masked.store.{_suffix(array.dtype)}.p0"
        _call(builder, name, ir.VoidType(), args[3], place, size, args[2])
        return context.get_dummy_value()

    return types.void(array, types.intp, mask, vector), generate


@intrinsic
def fetch(typing: Any, array: Any, index: Any) -> Any:
    """array[index], without looking whether the index is negative."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], *args))

    return array.dtype(array, types.intp), generate


@intrinsic
def put(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] = value, without looking whether the index is negative."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        number = context.cast(builder, args[2], sig.args[2], array.dtype)
        builder.store(number, _pointer(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of array[index]; any index is allowed."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = builder.bitcast(_pointer(context, builder, sig.args[0], *args), ir.IntType(8).as_pointer())
        read, keep, data = (ir.Constant(_I32, number) for number in (0, 3, 1))
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), pointer, read, keep, data)
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


# Arithmetic -----------------------------------------------------------------------------------------------------------


@intrinsic
def spread(typing: Any, array: Any, value: Any) -> Any:
    """The number in every lane of a vector of the array's type."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _as_vector(context, builder, args[1], sig.args[1], array.dtype)

    return VectorType(array.dtype)(array, value), generate


@intrinsic
def lanes_below(typing: Any, array: Any, count: Any) -> Any:
    """Mask of the first `count` lanes; the array is of any type."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.VectorType(_I64, LANES)
        return builder.icmp_signed("<", ir.Constant(kind, list(range(LANES))), _spread(builder, args[1]))

    return _MASK(array, types.int64), generate


@intrinsic
def fma(typing: Any, x: Any, y: Any, z: Any) -> Any:
    """X y + z, rounded once where the processor has such an instruction."""
    element = _element_of((x, y, z))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = (_as_vector(context, builder, *pair, element) for pair in zip(args, sig.args, strict=True))
        return _fma(builder, element, *vectors)

    return (VectorType(element)(x, y, z), generate) if element else None


def _choice(comparison: str) -> Any:
    @intrinsic
    def choose(typing: Any, x: Any, y: Any) -> Any:
        element = _element_of((x, y))

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            a, b = (_as_vector(context, builder, *pair, element) for pair in zip(args, sig.args, strict=True))
            return builder.select(builder.fcmp_ordered(comparison, a, b), a, b)

        return (VectorType(element)(x, y), generate) if element else None

    return choose


minimum = _choice("<")  # of a NaN and a number: the second argument
maximum = _choice(">")


@intrinsic
def select(typing: Any, mask: Any, x: Any, y: Any) -> Any:
    """Lane by lane: x where the mask holds, else y."""
    element = _element_of((x, y))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = (_as_vector(context, builder, *pair, element) for pair in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], a, b)

    return (VectorType(element)(mask, x, y), generate) if element else None


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


@intrinsic
def exp2(typing: Any, x: Any) -> Any:
    """2^x for |x| < 126, with a relative error below 2e-7 (float64: 4e-16); any number for other x.

    With n = round(x), 2^x = 2^n 2^(x - n): a polynomial, and n added to the exponent's bits.
    """
    element = x.element
    mantissa = 23 if element == types.float32 else 52

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        integers = _integers(element)
        rounder = _number(element, 1.5 * 2**mantissa)  # adding it leaves round(x) in the lowest bits
        shifted = builder.fadd(args[0], rounder)
        f = builder.fsub(args[0], builder.fsub(shifted, rounder))
        power = _number(element, _EXP2[element][-1])
        for coefficient in _EXP2[element][-2::-1]:
            power = _fma(builder, element, power, f, _number(element, coefficient))
        exponent = builder.shl(builder.bitcast(shifted, integers), _constant(integers, mantissa))
        return builder.bitcast(builder.add(builder.bitcast(power, integers), exponent), args[0].type)

    return x(x), generate


@intrinsic
def reciprocal(typing: Any, x: Any) -> Any:
    """1 / x for x in [0.001, 1000], with a relative error below 2e-7; exactly rounded for float64.

    Newton's iteration doubles the correct bits of a first guess read off the exponent: cheaper than a division.
    """

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if x.element == types.float64:
            return builder.fdiv(_number(x.element, 1.0), args[0])
        integers = _integers(x.element)
        guess = builder.bitcast(
            builder.sub(_constant(integers, 0x7EF311C3), builder.bitcast(args[0], integers)), args[0].type
        )
        minus_x = builder.fsub(_number(x.element, -0.0), args[0])
        for _ in range(3):
            guess = builder.fmul(guess, _fma(builder, x.element, minus_x, guess, _number(x.element, 2.0)))
        return guess

    return x(x), generate


# Across the lanes -----------------------------------------------------------------------------------------------------


@intrinsic
def bits(typing: Any, mask: Any) -> Any:
    """The mask as a number: bit i is lane i."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _I32)

    return types.uint32(mask), generate


@njit(forceinline=True)
def any_of(mask: Any) -> bool:
    """Whether some lane of the mask holds."""
    return bits(mask) != 0  # type: ignore[no-any-return]


@intrinsic
def trailing_zeros(typing: Any, number: Any) -> Any:
    """Position of the lowest bit that is set; the number is not 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.cttz(args[0], ir.Constant(_I1, 1)), _I64)

    return types.int64(types.uint32), generate


@intrinsic
def sum_lanes(typing: Any, x: Any) -> Any:
    """The sum of a vector's numbers: pairs half a vector apart first."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        total, width = args[0], LANES
        while width > 1:
            width //= 2
            order = [(i + width) % LANES for i in range(LANES)]
            total = builder.fadd(total, _shuffle(builder, total, total, order))
        return builder.extract_element(total, ir.Constant(_I32, 0))

    return x.element(x), generate


def _shuffle(builder: Any, x: Any, y: Any, order: list[int]) -> Any:
    """Lanes of x (0 to LANES - 1) and y (LANES and up) in the given order."""
    return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(_I32, LANES), order))


@intrinsic
def sum_many(typing: Any, vectors: Any) -> Any:
    """Vector whose lane i is the sum of the i-th of up to LANES vectors; 0 in the lanes beyond.

    Neighbours are added pairwise, then pairs, and so on, each time with half of the lanes of both: about 4 operations
    per sum, where one sum after another would take 8.
    """
    element = vectors.dtype.element

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = cgutils.unpack_tuple(builder, args[0], vectors.count)
        rows += [_number(element, 0.0)] * (LANES - len(rows))
        step = 1
        while len(rows) > 1:  # lanes with the bit `step` set come from the second vector
            kept = [i if not i & step else LANES + (i ^ step) for i in range(LANES)]
            other = [i ^ step if not i & step else LANES + i for i in range(LANES)]
            rows = [
                builder.fadd(_shuffle(builder, x, y, kept), _shuffle(builder, x, y, other))
                for x, y in zip(rows[::2], rows[1::2], strict=True)
            ]
            step *= 2
        return rows[0]

    return vectors.dtype(vectors), generate


@intrinsic
def transpose(typing: Any, rows: Any) -> Any:
    """LANES vectors, lane j of the i-th from lane i of the j-th."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors, step = cgutils.unpack_tuple(builder, args[0], LANES), 1
        while step < LANES:  # swap the off-diagonal squares of side `step`
            upper = [i if not i & step else LANES + i - step for i in range(LANES)]
            lower = [i + step if not i & step else LANES + i for i in range(LANES)]
            for i in range(LANES):
                if not i & step:
                    x, y = vectors[i], vectors[i + step]
                    vectors[i], vectors[i + step] = _shuffle(builder, x, y, upper), _shuffle(builder, x, y, lower)
            step *= 2
        return context.make_tuple(builder, rows, vectors)

    return rows(rows), generate


@intrinsic
def regroup(typing: Any, rows: Any) -> Any:
    """Four vectors of four quarters each: quarter j of the i-th comes from quarter i of the j-th."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b, c, d = cgutils.unpack_tuple(builder, args[0], 4)
        quarter, vectors = LANES // 4, []
        for i in range(4):
            mine = list(range(i * quarter, (i + 1) * quarter))
            pair = mine + [LANES + lane for lane in mine]
            left = _shuffle(builder, a, b, pair * 2)
            right = _shuffle(builder, c, d, pair * 2)
            half = LANES // 2
            vectors.append(_shuffle(builder, left, right, [*range(half), *range(LANES + half, 2 * LANES)]))
        return context.make_tuple(builder, rows, vectors)

    return rows(rows), generate


# Several vectors in registers: tuples whose length is known when compiling ---------------------------------------------


def _several(element: Any, count: int) -> Any:
    return types.UniTuple(VectorType(element), count)


@intrinsic
def load_many(typing: Any, like: Any, array: Any, index: Any, stride: Any) -> Any:
    """As many vectors as the tuple `like` is long, the k-th from array[index + k stride]."""
    kind = _several(array.dtype, len(like))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer, vectors = _pointer(context, builder, array, args[1], args[2]), []
        for _ in range(kind.count):
            place = builder.bitcast(pointer, _vector(array.dtype).as_pointer())
            vectors.append(builder.load(place, align=array.dtype.bitwidth // 8))
            pointer = builder.gep(pointer, [args[3]])
        return context.make_tuple(builder, kind, vectors)

    return kind(like, array, types.intp, types.intp), generate


@intrinsic
def store_many(typing: Any, array: Any, index: Any, stride: Any, vectors: Any) -> Any:
    """Write the k-th vector to array[index + k stride]."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, array, args[0], args[1])
        for vector in cgutils.unpack_tuple(builder, args[3], vectors.count):
            builder.store(vector, builder.bitcast(pointer, vector.type.as_pointer()), align=array.dtype.bitwidth // 8)
            pointer = builder.gep(pointer, [args[2]])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, vectors), generate


@intrinsic
def spread_many(typing: Any, like: Any, array: Any, index: Any, stride: Any) -> Any:
    """As many vectors as the tuple `like` is long, the k-th full of array[index + k stride]."""
    kind = _several(array.dtype, len(like))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer, vectors = _pointer(context, builder, array, args[1], args[2]), []
        for _ in range(kind.count):
            vectors.append(_spread(builder, builder.load(pointer)))
            pointer = builder.gep(pointer, [args[3]])
        return context.make_tuple(builder, kind, vectors)

    return kind(like, array, types.intp, types.intp), generate


@intrinsic
def zero_many(typing: Any, like: Any, array: Any) -> Any:
    """As many vectors of zeros of the array's type as the tuple `like` is long."""
    kind = _several(array.dtype, len(like))

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.make_tuple(builder, kind, [_number(array.dtype, 0.0)] * kind.count)

    return kind(like, array), generate


@intrinsic
def add_outer(typing: Any, sums: Any, left: Any, right: Any) -> Any:
    """sums[i n + j] + left[i] * right[j], with n = len(right)."""
    element, n = sums.dtype.element, right.count

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        totals, x, y = (
            cgutils.unpack_tuple(builder, arg, kind.count) for arg, kind in zip(args, sig.args, strict=True)
        )
        added = [_fma(builder, element, x[k // n], y[k % n], total) for k, total in enumerate(totals)]
        return context.make_tuple(builder, sums, added)

    return sums(sums, left, right), generate


@intrinsic
def add_dot(typing: Any, start: Any, left: Any, right: Any) -> Any:
    """Start + left[0] right[0] + left[1] right[1] + ..., one after another."""
    element = start.element

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        total = args[0]
        rows = (cgutils.unpack_tuple(builder, args[i], left.count) for i in (1, 2))
        for x, y in zip(*rows, strict=True):
            total = _fma(builder, element, x, y, total)
        return total

    return start(start, left, right), generate
