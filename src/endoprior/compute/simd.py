# pyright: reportCallIssue=false
"""Sixteen float32 side by side, as a Numba type: kernels use vectors explicitly instead of relying on
the compiler to vectorize.

The operations carry no fast-math flag: each rounds once, as written, so that two kernels that use the same lines take
bit-identical decisions.

LLVM maps the type to what the processor has: one register of AVX-512, two of AVX2, four of SSE or NEON. Kernels that
sum have the fast-math flags `REORDERED` instead.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

REORDERED = {"reassoc", "contract", "nsz", "arcp", "afn"}
"""Sums may be reordered and products fused, so that loops vectorize; NaN and infinity keep their meaning. Compiled code
still gives the same bits every time."""


class LaneType(types.Type):
    """`count` float32 numbers; `llvm` is the vector, `llvm_ints` its lane numbers' type."""

    def __init__(self, count: int) -> None:
        super().__init__(name=f"float32x{count}")
        self.count = count
        self.llvm = ir.VectorType(ir.FloatType(), count)
        self.llvm_ints = ir.VectorType(ir.IntType(32), count)


@register_model(LaneType)
class LaneModel(models.PrimitiveModel):
    """A value is one LLVM vector."""

    def __init__(self, manager: Any, lane_type: LaneType) -> None:
        super().__init__(manager, lane_type, lane_type.llvm)


LANES = 16
vector = LaneType(LANES)
_INT = ir.IntType(32)
Emit = Callable[..., Any]
"""Writes LLVM code: `emit(builder, *values)` returns the resulting value."""


def _elementwise(arity: int, emit: Emit) -> Any:
    """An intrinsic of `arity` vectors that returns the vector `emit(builder, *values)`."""
    signature = vector(*(vector,) * arity)

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return emit(builder, *args)

    by_arity = {  # spelled out because `intrinsic` reads the parameter names
        1: lambda _typing, _a: (signature, generate),
        2: lambda _typing, _a, _b: (signature, generate),
        3: lambda _typing, _a, _b, _c: (signature, generate),
        4: lambda _typing, _a, _b, _c, _d: (signature, generate),
    }
    return intrinsic(by_arity[arity])


def _add_operator(operation: Any, instruction: str) -> None:
    """Compile `operation` on two vectors to the LLVM instruction of that name."""
    apply = _elementwise(2, lambda builder, a, b: getattr(builder, instruction)(a, b))
    overload(operation)(lambda a, b: (lambda a, b: apply(a, b)) if a is b is vector else None)


_add_operator(operator.add, "fadd")
_add_operator(operator.sub, "fsub")
_add_operator(operator.mul, "fmul")
_add_operator(operator.truediv, "fdiv")
_negative = _elementwise(1, lambda builder, a: builder.fneg(a))
overload(operator.neg)(lambda a: (lambda a: _negative(a)) if a is vector else None)


def _call(name: str) -> Emit:
    def emit(builder: Any, *args: Any) -> Any:
        function_type = ir.FunctionType(vector.llvm, [vector.llvm] * len(args))
        function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{LANES}f32")
        return builder.call(function, args)

    return emit


def _choose(relation: str) -> Emit:
    """Emit `a if a relation b else b`, lane by lane; b where either is NaN."""
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(relation, a, b), a, b)


def _scale(builder: Any, mantissa: Any, exponent: Any) -> Any:
    shift = ir.Constant(vector.llvm_ints, [23] * LANES)
    added = builder.shl(builder.fptosi(exponent, vector.llvm_ints), shift)
    return builder.bitcast(builder.add(builder.bitcast(mantissa, vector.llvm_ints), added), vector.llvm)


square_root = _elementwise(1, _call("sqrt"))
magnitude = _elementwise(1, _call("fabs"))
floor = _elementwise(1, _call("floor"))
fma = _elementwise(3, _call("fma"))
"""a * b + c, rounded once."""
smaller = _elementwise(2, _choose("<"))
larger = _elementwise(2, _choose(">"))
where_ge = _elementwise(4, lambda builder, a, b, c, d: builder.select(builder.fcmp_ordered(">=", a, b), c, d))
"""c where a >= b, else d."""
scale_by_power_of_two = _elementwise(2, _scale)
"""a * 2**b for whole b, by adding to the exponent bits: meaningless where the result leaves the normal numbers."""


@intrinsic
def broadcast(_typing: Any, value: Any) -> Any:
    """The number in every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = context.cast(builder, args[0], signature.args[0], types.float32)
        first = builder.insert_element(ir.Constant(vector.llvm, ir.Undefined), number, ir.Constant(_INT, 0))
        return builder.shuffle_vector(first, first, ir.Constant(vector.llvm_ints, [0] * LANES))

    return vector(value), generate


@intrinsic
def lane_numbers(_typing: Any) -> Any:
    """0, 1, 2, ... LANES - 1."""

    def generate(_context: Any, _builder: Any, _signature: Any, _args: Any) -> Any:
        return ir.Constant(vector.llvm, [float(i) for i in range(LANES)])

    return vector(), generate


def _fold(emit: Emit) -> Any:
    """The intrinsic that brings all lanes to one number by `emit(builder, low, high)`, halves first."""

    def fold(_typing: Any, _a: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            value, width = args[0], LANES
            while width > 1:
                width //= 2
                index = ir.VectorType(_INT, width)
                low = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width))))
                high = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width, 2 * width))))
                value = emit(builder, low, high)
            return builder.extract_element(value, ir.Constant(_INT, 0))

        return types.float32(vector), generate

    return intrinsic(fold)


total = _fold(lambda builder, low, high: builder.fadd(low, high))
"""Sum of the lanes, halves first."""
largest = _fold(_choose(">"))
"""The largest of the lanes; meaningless where one is NaN."""


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Pointer to the vector that begins at element args[1] of the flat, contiguous array args[0]."""
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]]), vector.llvm.as_pointer())


def _copy(builder: Any, source: Any, target: Any, count: Any) -> None:
    """Copy `count` floats one by one between two pointers."""
    number = ir.FloatType().as_pointer()
    source, target = builder.bitcast(source, number), builder.bitcast(target, number)
    with cgutils.for_range(builder, count) as loop:
        builder.store(builder.load(builder.gep(source, [loop.index])), builder.gep(target, [loop.index]))


@intrinsic
def load_some(_typing: Any, array: Any, _offset: Any, lanes: Any) -> Any:
    """`load` of the first `lanes` elements, then zeros: slow, for what is left over. None loads all, as `load` does."""
    whole = isinstance(lanes, types.NoneType)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _pointer(context, builder, signature, args)
        if whole:
            return builder.load(address, align=4)
        slot = cgutils.alloca_once(builder, vector.llvm)
        builder.store(ir.Constant(vector.llvm, [0.0] * LANES), slot)
        _copy(builder, address, slot, args[2])
        return builder.load(slot)

    return vector(array, types.intp, types.none if whole else types.intp), generate


@intrinsic
def store_some(_typing: Any, array: Any, _offset: Any, _value: Any, lanes: Any) -> Any:
    """`store` of the first `lanes` elements; None stores all."""
    whole = isinstance(lanes, types.NoneType)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _pointer(context, builder, signature, args)
        if whole:
            builder.store(args[2], address, align=4)
        else:
            slot = cgutils.alloca_once(builder, vector.llvm)
            builder.store(args[2], slot)
            _copy(builder, slot, address, args[3])
        return context.get_dummy_value()

    return types.none(array, types.intp, vector, types.none if whole else types.intp), generate


@intrinsic
def load(_typing: Any, array: Any, _offset: Any) -> Any:
    """Elements of a flat array from `offset` on; not checked."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, signature, args), align=4)

    return vector(array, types.intp), generate


@intrinsic
def store(_typing: Any, array: Any, _offset: Any, _value: Any) -> Any:
    """Write elements of a flat array from `offset` on; not checked."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, signature, args), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, vector), generate


@intrinsic
def prefetch(_typing: Any, array: Any, _offset: Any) -> Any:
    """Ask for the cache line of element `offset` of a flat array; any offset is safe."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte_pointer = ir.IntType(8).as_pointer()
        address = builder.bitcast(_pointer(context, builder, signature, args), byte_pointer)
        function_type = ir.FunctionType(ir.VoidType(), [byte_pointer, _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch")
        builder.call(function, [address, _INT(0), _INT(3), _INT(1)])  # to read, into the nearest cache, data
        return context.get_dummy_value()

    return types.none(array, types.intp), generate


# Minimax fit of 2^f on [0, 1): relative error 9e-8 with these coefficients in float32.
_E0, _E1, _E2, _E3, _E4, _E5 = (
    np.float32(c) for c in (0.99999993, 0.69315307, 0.24015361, 0.05582634, 0.00898931, 0.00187759)
)


@njit(forceinline=True)
def power_of_two(exponent):
    # 2^exponent; meaningless outside of [-126, 127].
    whole = floor(exponent)
    f = exponent - whole
    series = fma(broadcast(_E5), f, broadcast(_E4))
    series = fma(series, f, broadcast(_E3))
    series = fma(series, f, broadcast(_E2))
    series = fma(series, f, broadcast(_E1))
    series = fma(series, f, broadcast(_E0))
    return scale_by_power_of_two(series, whole)
