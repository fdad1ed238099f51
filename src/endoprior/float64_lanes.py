"""Eight float64 side by side, as a Numba type, with masks that are plain bytes (bit l is lane l).

LLVM maps it to what the processor has (one register of AVX-512, two of AVX2, four of SSE or NEON). The operations carry
no fast-math flag: each rounds once, as written, so that results equal those of the same formula in NumPy, bit for bit.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

LANES = 8
FLOATS = ir.VectorType(ir.DoubleType(), LANES)
INTS = ir.VectorType(ir.IntType(32), LANES)
BITS = ir.VectorType(ir.IntType(1), LANES)


class Lanes(types.Type):
    """The Numba type of LANES float64."""

    def __init__(self) -> None:
        super().__init__(name=f"float64x{LANES}")


lanes = Lanes()


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    """A Lanes is one LLVM vector value."""

    def __init__(self, manager: Any, numba_type: Lanes) -> None:
        super().__init__(manager, numba_type, FLOATS)


def _binary(result: Any, emit: Any) -> Any:
    """An intrinsic of two Lanes that returns `emit(builder, a, b)`."""

    def typed(typing_context: Any, a: Any, b: Any) -> Any:
        return result(lanes, lanes), lambda context, builder, signature, args: emit(builder, *args)

    return intrinsic(typed)


def _compare(relation: str) -> Any:
    """An intrinsic of two Lanes that returns the byte of lanes where the relation holds; it never does for NaN."""
    return _binary(
        types.uint8, lambda builder, a, b: builder.bitcast(builder.fcmp_ordered(relation, a, b), ir.IntType(LANES))
    )


add = _binary(lanes, lambda builder, a, b: builder.fadd(a, b))
subtract = _binary(lanes, lambda builder, a, b: builder.fsub(a, b))
multiply = _binary(lanes, lambda builder, a, b: builder.fmul(a, b))
larger = _binary(lanes, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
less = _compare("<")
equal = _compare("==")

overload(operator.add)(lambda a, b: (lambda a, b: add(a, b)) if a is b is lanes else None)
overload(operator.sub)(lambda a, b: (lambda a, b: subtract(a, b)) if a is b is lanes else None)
overload(operator.mul)(lambda a, b: (lambda a, b: multiply(a, b)) if a is b is lanes else None)


@intrinsic
def pick(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """`a` in the lanes of the mask, `b` in the others."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.bitcast(args[0], BITS), args[1], args[2])

    return lanes(types.uint8, lanes, lanes), generate


@intrinsic
def splat(typing_context: Any, value: Any) -> Any:
    """The number, LANES times."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        first = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), args[0], ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, first, ir.Constant(INTS, [0] * LANES))

    return lanes(types.float64), generate


@intrinsic
def largest(typing_context: Any, a: Any) -> Any:
    """The largest lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, width = args[0], LANES
        while width > 1:
            width //= 2
            index = ir.VectorType(ir.IntType(32), width)
            low = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width))))
            high = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width, 2 * width))))
            value = builder.select(builder.fcmp_ordered(">", low, high), low, high)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float64(lanes), generate


def _address(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Pointer to element args[1] of the one-dimensional contiguous float64 array args[0]."""
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]]), FLOATS.as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, offset: Any) -> Any:
    """LANES elements of a flat float64 array, from `offset` on; not checked."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, signature, args), align=8)

    return lanes(array, types.intp), generate


@intrinsic
def store(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write LANES elements of a flat float64 array, from `offset` on; not checked."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, signature, args), align=8)
        return context.get_dummy_value()

    return types.none(array, types.intp, lanes), generate
