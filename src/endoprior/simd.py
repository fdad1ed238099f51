"""Sixteen float32 side by side, as a Numba type: a kernel says itself what is a vector, instead of hoping for it.

LLVM maps it to what the processor has (one register of AVX-512, two of AVX2, four of SSE or NEON). The operations carry
no fast-math flag: each rounds once, as written, so that two kernels that use the same lines take bit-identical
decisions.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 16
FLOATS = ir.VectorType(ir.FloatType(), LANES)
INTS = ir.VectorType(ir.IntType(32), LANES)


class Vector(types.Type):
    """The Numba type of LANES float32."""

    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


vector = Vector()


@register_model(Vector)
class VectorModel(models.PrimitiveModel):
    """A Vector is one LLVM vector value."""

    def __init__(self, manager: Any, numba_type: Vector) -> None:
        super().__init__(manager, numba_type, FLOATS)


def _elementwise(arity: int, emit: Any) -> Any:
    """An intrinsic of `arity` vectors that returns the vector `emit(builder, *values)`."""
    signature = vector(*(vector,) * arity)

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return emit(builder, *args)

    by_arity = {  # spelled out because `intrinsic` reads the parameter names
        1: lambda typing_context, a: (signature, generate),
        2: lambda typing_context, a, b: (signature, generate),
        3: lambda typing_context, a, b, c: (signature, generate),
        4: lambda typing_context, a, b, c, d: (signature, generate),
    }
    return intrinsic(by_arity[arity])


def _call(name: str) -> Any:
    """Emit a call of the LLVM intrinsic of that name on vectors."""

    def emit(builder: Any, *args: Any) -> Any:
        function_type = ir.FunctionType(FLOATS, [FLOATS] * len(args))
        return builder.call(
            cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{LANES}f32"), args
        )

    return emit


add = _elementwise(2, lambda builder, a, b: builder.fadd(a, b))
subtract = _elementwise(2, lambda builder, a, b: builder.fsub(a, b))
multiply = _elementwise(2, lambda builder, a, b: builder.fmul(a, b))
divide = _elementwise(2, lambda builder, a, b: builder.fdiv(a, b))
negative = _elementwise(1, lambda builder, a: builder.fneg(a))
magnitude = _elementwise(1, _call("fabs"))
floor = _elementwise(1, _call("floor"))
fma = _elementwise(3, _call("fma"))
"""a * b + c, rounded once."""
smaller = _elementwise(2, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
larger = _elementwise(2, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
where_ge = _elementwise(4, lambda builder, a, b, c, d: builder.select(builder.fcmp_ordered(">=", a, b), c, d))
"""c where a >= b, else d."""


def _scale(builder: Any, mantissa: Any, exponent: Any) -> Any:
    shift = ir.Constant(INTS, [23] * LANES)
    bits = builder.add(builder.bitcast(mantissa, INTS), builder.shl(builder.fptosi(exponent, INTS), shift))
    return builder.bitcast(bits, FLOATS)


scale_by_power_of_two = _elementwise(2, _scale)
"""a * 2**b for whole b, by adding to the exponent bits: meaningless where the result leaves the normal numbers."""

overload(operator.add)(lambda a, b: (lambda a, b: add(a, b)) if a is b is vector else None)
overload(operator.sub)(lambda a, b: (lambda a, b: subtract(a, b)) if a is b is vector else None)
overload(operator.mul)(lambda a, b: (lambda a, b: multiply(a, b)) if a is b is vector else None)
overload(operator.truediv)(lambda a, b: (lambda a, b: divide(a, b)) if a is b is vector else None)
overload(operator.neg)(lambda a: (lambda a: negative(a)) if a is vector else None)


@intrinsic
def splat(typing_context: Any, value: Any) -> Any:
    """The number, LANES times."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = context.cast(builder, args[0], signature.args[0], types.float32)
        first = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, first, ir.Constant(INTS, [0] * LANES))

    return vector(value), generate


@intrinsic
def lane_numbers(typing_context: Any) -> Any:
    """0, 1, 2, ... LANES - 1."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(FLOATS, [float(i) for i in range(LANES)])

    return vector(), generate


def _address(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Pointer to element args[1] of the one-dimensional contiguous float32 array args[0]."""
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]]), FLOATS.as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, offset: Any) -> Any:
    """LANES elements of a flat float32 array, from `offset` on; not checked."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, signature, args), align=4)

    return vector(array, types.intp), generate


@intrinsic
def store(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write LANES elements of a flat float32 array, from `offset` on; not checked."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, signature, args), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, vector), generate


@intrinsic
def prefetch(typing_context: Any, array: Any, offset: Any) -> Any:
    """Ask for the cache line of element `offset` of a flat array; any offset is safe."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte_pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        address = builder.bitcast(_address(context, builder, signature, args), byte_pointer)
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
        address = _address(context, builder, signature, args)
        if isinstance(lanes, types.NoneType):
            return builder.load(address, align=4)
        slot = cgutils.alloca_once(builder, FLOATS)
        builder.store(ir.Constant(FLOATS, [0.0] * LANES), slot)
        _copy(builder, address, slot, args[2])
        return builder.load(slot)

    return vector(array, types.intp, types.none if isinstance(lanes, types.NoneType) else types.intp), generate


@intrinsic
def store_some(typing_context: Any, array: Any, offset: Any, value: Any, lanes: Any) -> Any:
    """`store` of the first `lanes` elements; None stores all."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature, args)
        if isinstance(lanes, types.NoneType):
            builder.store(args[2], address, align=4)
        else:
            slot = cgutils.alloca_once(builder, FLOATS)
            builder.store(args[2], slot)
            _copy(builder, slot, address, args[3])
        return context.get_dummy_value()

    number = types.none if isinstance(lanes, types.NoneType) else types.intp
    return types.none(array, types.intp, vector, number), generate


@intrinsic
def total(typing_context: Any, a: Any) -> Any:
    """Sum of the lanes, halves first."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, width = args[0], LANES
        while width > 1:
            width //= 2
            index = ir.VectorType(ir.IntType(32), width)
            low = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width))))
            high = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width, 2 * width))))
            value = builder.fadd(low, high)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(vector), generate
