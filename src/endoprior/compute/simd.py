"""Sixteen float32 side by side, as a Numba type: kernels use vectors explicitly instead of relying on
the compiler to vectorize.

Every operation rounds once, so that two kernels that use the same lines take bit-identical decisions.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .lane_types import LaneType, add_operators, choose, elementwise, fold_of, load_of, pointer_to, splat_of, store_of

LANES = 16
vector = LaneType(types.float32, LANES)
add_operators(vector)
splat, load, store = splat_of(vector), load_of(vector), store_of(vector)
total = fold_of(vector, lambda builder, low, high: builder.fadd(low, high))
"""Sum of the lanes, halves first."""
largest = fold_of(vector, choose(">"))
"""The largest of the lanes; meaningless where one is NaN."""


def _call(name: str) -> Any:
    """Emit a call of the LLVM intrinsic of that name on vectors."""

    def emit(builder: Any, *args: Any) -> Any:
        function_type = ir.FunctionType(vector.llvm, [vector.llvm] * len(args))
        return builder.call(
            cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{LANES}f32"), args
        )

    return emit


square_root = elementwise(vector, 1, _call("sqrt"))
magnitude = elementwise(vector, 1, _call("fabs"))
floor = elementwise(vector, 1, _call("floor"))
fma = elementwise(vector, 3, _call("fma"))
"""a * b + c, rounded once."""
smaller = elementwise(vector, 2, choose("<"))
larger = elementwise(vector, 2, choose(">"))
where_ge = elementwise(vector, 4, lambda builder, a, b, c, d: builder.select(builder.fcmp_ordered(">=", a, b), c, d))
"""c where a >= b, else d."""


def _scale(builder: Any, mantissa: Any, exponent: Any) -> Any:
    shift = ir.Constant(vector.llvm_ints, [23] * LANES)
    added = builder.shl(builder.fptosi(exponent, vector.llvm_ints), shift)
    return builder.bitcast(builder.add(builder.bitcast(mantissa, vector.llvm_ints), added), vector.llvm)


scale_by_power_of_two = elementwise(vector, 2, _scale)
"""a * 2**b for whole b, by adding to the exponent bits: meaningless where the result leaves the normal numbers."""


@intrinsic
def lane_numbers(typing_context: Any) -> Any:
    """0, 1, 2, ... LANES - 1."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(vector.llvm, [float(i) for i in range(LANES)])

    return vector(), generate


@intrinsic
def prefetch(typing_context: Any, array: Any, offset: Any) -> Any:
    """Ask for the cache line of element `offset` of a flat array; any offset is safe."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte_pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        address = builder.bitcast(pointer_to(vector, context, builder, signature, args), byte_pointer)
        function_type = ir.FunctionType(ir.VoidType(), [byte_pointer, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch")
        builder.call(function, [address, number(0), number(3), number(1)])  # to read, into the nearest cache, data
        return context.get_dummy_value()

    return types.none(array, types.intp), generate


def _copy(builder: Any, source: Any, target: Any, count: Any) -> None:
    """Copy `count` floats one by one between two pointers."""
    number = ir.FloatType().as_pointer()
    source, target = builder.bitcast(source, number), builder.bitcast(target, number)
    with cgutils.for_range(builder, count) as loop:
        builder.store(builder.load(builder.gep(source, [loop.index])), builder.gep(target, [loop.index]))


@intrinsic
def load_some(typing_context: Any, array: Any, offset: Any, lanes: Any) -> Any:
    """`load` of the first `lanes` elements, then zeros: slow, for what is left over. None loads all, as `load` does."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = pointer_to(vector, context, builder, signature, args)
        if isinstance(lanes, types.NoneType):
            return builder.load(address, align=4)
        slot = cgutils.alloca_once(builder, vector.llvm)
        builder.store(ir.Constant(vector.llvm, [0.0] * LANES), slot)
        _copy(builder, address, slot, args[2])
        return builder.load(slot)

    return vector(array, types.intp, types.none if isinstance(lanes, types.NoneType) else types.intp), generate


@intrinsic
def store_some(typing_context: Any, array: Any, offset: Any, value: Any, lanes: Any) -> Any:
    """`store` of the first `lanes` elements; None stores all."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = pointer_to(vector, context, builder, signature, args)
        if isinstance(lanes, types.NoneType):
            builder.store(args[2], address, align=4)
        else:
            slot = cgutils.alloca_once(builder, vector.llvm)
            builder.store(args[2], slot)
            _copy(builder, slot, address, args[3])
        return context.get_dummy_value()

    number = types.none if isinstance(lanes, types.NoneType) else types.intp
    return types.none(array, types.intp, vector, number), generate
