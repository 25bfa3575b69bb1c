"""Vectors of float32 for Numba, one register wide, for the loops that LLVM's own vectoriser serves badly.

LLVM vectorises a loop over pixels well, but not a loop in which some sums run along one axis and some along the other,
and it starts every short loop with a dozen instructions that ask whether there is anything to do. A `Vector` is what
such a loop would have made of `LANES` neighbouring pixels, written down: its operators work lane by lane, a number
stands for itself in every lane, and a comparison gives a `Mask`. Multiplications and additions may be fused.
"""

from __future__ import annotations

import operator
from typing import Any, ClassVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from ....compiled import njit

_FUSED = ("contract", "nsz", "arcp")


def _features() -> list[str]:
    """What Numba compiles for, with all that its settings take away; also part of its cache's key."""
    return str(cpu_target.target_context.codegen().magic_tuple()[2]).split(",")


# 16 where registers hold 512 bits, else 8: one register with AVX2, two with NEON or SSE.
LANES = 16 if "+avx512f" in _features() else 8
# An estimate of 1/√x: LLVM's name of the instruction, and whether it wants to know which lanes to leave out.
_ESTIMATE = (
    ("llvm.x86.avx512.rsqrt14.ps.512", "masked")
    if LANES == 16
    else ("llvm.x86.avx.rsqrt.ps.256",)
    if "+avx" in _features()
    else None
)
ROOT_OPERATIONS = 2 if _ESTIMATE is None else 6
"""Additions, multiplications, divisions and square roots of one `inverse_root`."""
_FLOATS, _INTS, _BITS = (ir.VectorType(element, LANES) for element in (ir.FloatType(), ir.IntType(32), ir.IntType(1)))


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Vector({LANES})")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Mask({LANES})")


VECTOR, MASK = _VectorType(), _MaskType()
# Coefficients of 2ᶠ for |f| ≤ ½, the highest power first.
_POWERS_OF_TWO = np.array(
    [1.326472707e-3, 9.671512649e-3, 5.550733744e-2, 2.402224209e-1, 6.931469776e-1, 1.0], np.float32
)


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOATS)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _spread(builder: Any, value: Any) -> Any:
    """A number in every lane; a vector as it is."""
    if value.type == _FLOATS:
        return value
    one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


_PAIRS = ((VECTOR, VECTOR), (VECTOR, types.float32), (types.float32, VECTOR))


def _operator(function: Any, result: Any, emit: Any) -> None:
    """Teaches Numba `function` of a vector and a vector or number."""

    class Template(ConcreteTemplate):
        cases: ClassVar = [signature(result, *pair) for pair in _PAIRS]

    infer_global(function)(Template)
    for pair in _PAIRS:

        @lower_builtin(function, *pair)
        def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, *(_spread(builder, value) for value in args))


_operator(operator.add, VECTOR, lambda builder, a, b: builder.fadd(a, b, flags=_FUSED))
_operator(operator.sub, VECTOR, lambda builder, a, b: builder.fsub(a, b, flags=_FUSED))
_operator(operator.mul, VECTOR, lambda builder, a, b: builder.fmul(a, b, flags=_FUSED))
_operator(operator.truediv, VECTOR, lambda builder, a, b: builder.fdiv(a, b, flags=_FUSED))
_operator(operator.gt, MASK, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_operator(operator.ge, MASK, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_operator(operator.lt, MASK, lambda builder, a, b: builder.fcmp_ordered("<", a, b))


@infer_global(operator.and_)
class _And(ConcreteTemplate):
    cases: ClassVar = [signature(MASK, MASK, MASK)]


@lower_builtin(operator.and_, MASK, MASK)
def _and(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    return builder.and_(*args)


def _holds(array: Any, *kinds: Any) -> bool:
    """Whether it is a contiguous array of such numbers; a compiler's question, asked once."""
    return isinstance(array, types.Array) and array.layout == "C" and array.dtype in kinds


def _address(context: Any, builder: Any, signature: Any, array: Any, index: Any) -> Any:
    """Of an element of a contiguous array; the index counts elements from the array's first."""
    data = context.make_array(signature.args[0])(context, builder, array).data
    return builder.gep(data, [index])


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """`LANES` neighbouring float32 of a contiguous array of any shape, from the element `index` on; unchecked."""
    if not _holds(array, types.float32):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = _address(context, builder, signature, *args)
        return builder.load(builder.bitcast(place, _FLOATS.as_pointer()), align=4)

    return VECTOR(array, index), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, vector: Any) -> Any:
    """The opposite of `load`."""
    if not _holds(array, types.float32):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = _address(context, builder, signature, *args[:2])
        builder.store(args[2], builder.bitcast(place, _FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, index, vector), codegen


@intrinsic
def spread(typingctx: Any, value: Any) -> Any:
    """A vector with the float32 in every lane."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return VECTOR(types.float32), codegen


@intrinsic
def lane_numbers(typingctx: Any) -> Any:
    """0, 1, 2, ..."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(_FLOATS, [float(lane) for lane in range(LANES)])

    return VECTOR(), codegen


@intrinsic
def where(typingctx: Any, mask: Any, vector: Any) -> Any:
    """The vector's lanes that the mask has, 0 elsewhere."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(args[0], args[1], ir.Constant(_FLOATS, [0.0] * LANES))

    return VECTOR(mask, vector), codegen


@intrinsic
def least(typingctx: Any, vector: Any, bound: Any) -> Any:
    """min(vector, bound) for a number; the bound where a lane is NaN."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bound = _spread(builder, args[1])
        return builder.select(builder.fcmp_ordered("<", args[0], bound), args[0], bound)

    return VECTOR(vector, types.float32), codegen


@intrinsic
def totals(typingctx: Any, array: Any, index: Any, vectors: Any) -> Any:
    """Writes the sum of the lanes of each vector of a tuple into neighbouring places of a float32 array.

    Halves of two vectors are put side by side and added, then quarters of four, and so on: a third of the
    instructions that one sum after the other takes.
    """
    if not _holds(array, types.float32):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        count = len(signature.args[2])
        place = _address(context, builder, signature, *args[:2])
        left = [builder.extract_value(args[2], i) for i in range(count)]
        for begin in range(0, count, LANES):
            _add_lanes(builder, left[begin : begin + LANES], builder.gep(place, [ir.Constant(ir.IntType(64), begin)]))
        return context.get_dummy_value()

    return types.void(array, index, vectors), codegen


def _add_lanes(builder: Any, vectors: list[Any], place: Any) -> None:
    """The totals of up to `LANES` vectors to `place`."""
    count, nothing = len(vectors), ir.Constant(_FLOATS, ir.Undefined)
    # Whose sum each lane of each vector is part of.
    owners: list[list[int | None]] = [[number] * LANES for number in range(count)]
    width = LANES
    while width > 1:
        width //= 2
        if len(vectors) % 2 and len(vectors) > 1:
            vectors, owners = [*vectors, nothing], [*owners, [None] * LANES]
        seconds = vectors[1::2] or [nothing]
        owners_of_seconds = owners[1::2] or [[None] * LANES]
        low = [lane for lane in range(LANES) if lane // width % 2 == 0]
        high = [lane + width for lane in low]
        vectors = [_merge(builder, *pair, low, high) for pair in zip(vectors[::2], seconds, strict=True)]
        owners = [
            [first[lane] for lane in low] + [second[lane] for lane in low]
            for first, second in zip(owners[::2], owners_of_seconds, strict=True)
        ]
    lanes = [owners[0].index(number) for number in range(count)]
    _store_lanes(builder, vectors[0], lanes, place)


def _merge(builder: Any, first: Any, second: Any, low: list[int], high: list[int]) -> Any:
    """The lanes `low` of two vectors side by side, plus their lanes `high`."""
    sides = [
        builder.shuffle_vector(first, second, ir.Constant(_INTS, side + [lane + LANES for lane in side]))
        for side in (low, high)
    ]
    return builder.fadd(*sides, flags=_FUSED)


def _store_lanes(builder: Any, vector: Any, lanes: list[int], place: Any) -> None:
    """Some lanes, in that order, by stores of 8, 4, 2 and 1."""
    done = 0
    while done < len(lanes):
        size = 1 << ((len(lanes) - done).bit_length() - 1)
        order = ir.Constant(ir.VectorType(ir.IntType(32), size), lanes[done : done + size])
        part = builder.shuffle_vector(vector, vector, order)
        target = builder.gep(place, [ir.Constant(ir.IntType(64), done)])
        builder.store(part, builder.bitcast(target, part.type.as_pointer()), align=4)
        done += size


@intrinsic
def store_run(typingctx: Any, array: Any, index: Any, first: Any, step: Any) -> Any:
    """Writes the int32 first, first + step, first + 2 step, ... of `LANES` lanes into an int32 array."""
    if not _holds(array, types.int32):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = _address(context, builder, signature, *args[:2])
        none, zeros = ir.Constant(_INTS, ir.Undefined), ir.Constant(_INTS, [0] * LANES)
        first, step = (
            builder.shuffle_vector(builder.insert_element(none, value, ir.Constant(ir.IntType(32), 0)), none, zeros)
            for value in args[2:]
        )
        lanes = ir.Constant(_INTS, list(range(LANES)))
        run = builder.add(first, builder.mul(step, lanes))
        builder.store(run, builder.bitcast(place, _INTS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, index, types.int32, types.int32), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Asks for the cache line of an element of a contiguous array, which is read some time later."""
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        place = builder.bitcast(_address(context, builder, signature, *args), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        function = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        read, keep, data = (ir.Constant(flag, value) for value in (0, 3, 1))
        builder.call(function, [place, read, keep, data])
        return context.get_dummy_value()

    return types.void(array, index), codegen


@njit
def aligned(count: Any) -> Any:
    """An array of `count` float32 that begins where a vector may without straddling two lines of the cache."""
    whole = np.empty(count + 16, np.float32)
    skip = (-whole.ctypes.data & 63) // 4
    return whole[skip : skip + count]


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether the mask has any lane."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), ir.Constant(bits, 0))

    return types.boolean(mask), codegen


def _number(value: float) -> Any:
    return ir.Constant(_FLOATS, [value] * LANES)


@intrinsic
def inverse_root(typingctx: Any, x: Any) -> Any:
    """1/√x for 1e-37 ≤ x ≤ 1e37, relative error under 3e-7.

    The processor's estimate of 12 or 14 bits and a Newton step, where it has one: in a row, a root and a division
    take five times as long.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x = args[0]
        if _ESTIMATE is None:
            kind, name = ir.FunctionType(_FLOATS, [_FLOATS]), f"llvm.sqrt.v{LANES}f32"
            root = builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [x])
            return builder.fdiv(_number(1.0), root)
        name, *others = _ESTIMATE
        extra = [ir.Constant(_FLOATS, [0.0] * LANES), ir.Constant(ir.IntType(LANES), -1)] if others else []
        kind = ir.FunctionType(_FLOATS, [_FLOATS, *(value.type for value in extra)])
        y = builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [x, *extra])
        half = builder.fmul(y, _number(0.5))
        error = builder.fsub(_number(1.0), builder.fmul(builder.fmul(x, y), y, flags=_FUSED), flags=_FUSED)
        return builder.fadd(y, builder.fmul(half, error, flags=_FUSED), flags=_FUSED)

    return VECTOR(x), codegen


@intrinsic
def exp2_negative(typingctx: Any, x: Any) -> Any:
    """2ˣ for x ≤ 0, relative error under 3e-7; below −40, and for NaN, it stays at 2⁻⁴⁰ ≈ 9e-13."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kept = builder.select(builder.fcmp_ordered(">", args[0], _number(-40.0)), args[0], _number(-40.0))
        return _exp2(builder, kept)

    return VECTOR(x), codegen


@intrinsic
def exp2(typingctx: Any, x: Any) -> Any:
    """2ˣ for |x| ≤ 126, relative error under 3e-7."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _exp2(builder, args[0])

    return VECTOR(x), codegen


def _exp2(builder: Any, x: Any) -> Any:
    """2ⁿ·2ᶠ: n rounded by adding a number so large that no places are left after the point, a minimax polynomial for
    2ᶠ, |f| ≤ ½, and n's lowest bits added to its exponent.
    """
    rounding = _number(1.5 * 2.0**23)
    # No flags: this sum must be rounded as it stands.
    n = builder.fadd(x, rounding)
    f = builder.fsub(x, builder.fsub(n, rounding))

    def line(slope: Any, at: Any, offset: Any) -> Any:
        return builder.fadd(builder.fmul(slope, at, flags=_FUSED), offset, flags=_FUSED)

    c5, c4, c3, c2, c1, c0 = (_number(float(value)) for value in _POWERS_OF_TWO)
    # By halves, not coefficient by coefficient: the next lanes wait for three results instead of five.
    square = builder.fmul(f, f)
    upper = line(line(c5, f, c4), square, line(c3, f, c2))
    p = line(upper, square, line(c1, f, c0))
    shift = ir.Constant(_INTS, [23] * LANES)
    exponent = builder.shl(builder.bitcast(n, _INTS), shift)
    return builder.bitcast(builder.add(builder.bitcast(p, _INTS), exponent), _FLOATS)
