"""Numba types of several floats side by side, and what all of them have in common.

LLVM maps such a type to what the processor has (sixteen float32: one register of AVX-512, two of AVX2, four of SSE or
NEON). The operations carry no fast-math flag: each rounds once, as written.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

Emit = Callable[..., Any]
"""Writes LLVM code: `emit(builder, *values)` returns the resulting value."""


class LaneType(types.Type):
    """The Numba type of `count` numbers of type `element`; `llvm` is the vector, `llvm_ints` its lane numbers' type."""

    def __init__(self, element: types.Float, count: int) -> None:
        super().__init__(name=f"{element}x{count}")
        self.element, self.count = element, count
        self.llvm = ir.VectorType({32: ir.FloatType(), 64: ir.DoubleType()}[element.bitwidth], count)
        self.llvm_ints = ir.VectorType(ir.IntType(32), count)

    @property
    def align(self) -> int:
        """Bytes to which addresses are aligned for certain: those of one element."""
        return self.element.bitwidth // 8


@register_model(LaneType)
class LaneModel(models.PrimitiveModel):
    """A value is one LLVM vector."""

    def __init__(self, manager: Any, lane_type: LaneType) -> None:
        super().__init__(manager, lane_type, lane_type.llvm)


def elementwise(lane_type: LaneType, arity: int, emit: Emit, result: types.Type | None = None) -> Any:
    """An intrinsic of `arity` vectors that returns `emit(builder, *values)`: a vector, or a `result`."""
    signature = (result or lane_type)(*(lane_type,) * arity)

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return emit(builder, *args)

    by_arity = {  # spelled out because `intrinsic` reads the parameter names
        1: lambda typing_context, a: (signature, generate),
        2: lambda typing_context, a, b: (signature, generate),
        3: lambda typing_context, a, b, c: (signature, generate),
        4: lambda typing_context, a, b, c, d: (signature, generate),
    }
    return intrinsic(by_arity[arity])


def add_operators(lane_type: LaneType) -> None:
    """Let kernels write a + b, a - b, a * b, a / b and -a."""
    for name, operation in {"fadd": operator.add, "fsub": operator.sub, "fmul": operator.mul}.items():
        _overload_binary(lane_type, operation, name)
    _overload_binary(lane_type, operator.truediv, "fdiv")
    negative = elementwise(lane_type, 1, lambda builder, a: builder.fneg(a))
    overload(operator.neg)(lambda a: (lambda a: negative(a)) if a is lane_type else None)


def _overload_binary(lane_type: LaneType, operation: Any, name: str) -> None:
    """Compile `operation` on two vectors to the LLVM instruction of that name."""
    apply = elementwise(lane_type, 2, lambda builder, a, b: getattr(builder, name)(a, b))
    overload(operation)(lambda a, b: (lambda a, b: apply(a, b)) if a is b is lane_type else None)


def choose(relation: str) -> Emit:
    """Emit `a if a relation b else b`, lane by lane; b where either is NaN."""
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(relation, a, b), a, b)


def pointer_to(lane_type: LaneType, context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Pointer to the vector that begins at element args[1] of the flat, contiguous array args[0]."""
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]]), lane_type.llvm.as_pointer())


def splat_of(lane_type: LaneType) -> Any:
    """The intrinsic `splat(number)`: the number in every lane."""

    def splat(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            number = context.cast(builder, args[0], signature.args[0], lane_type.element)
            undefined = ir.Constant(lane_type.llvm, ir.Undefined)
            first = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(first, first, ir.Constant(lane_type.llvm_ints, [0] * lane_type.count))

        return lane_type(value), generate

    return intrinsic(splat)


def load_of(lane_type: LaneType) -> Any:
    """The intrinsic `load(array, offset)`: elements of a flat array from `offset` on; not checked."""

    def load(typing_context: Any, array: Any, offset: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.load(pointer_to(lane_type, context, builder, signature, args), align=lane_type.align)

        return lane_type(array, types.intp), generate

    return intrinsic(load)


def store_of(lane_type: LaneType) -> Any:
    """The intrinsic `store(array, offset, value)`: write elements of a flat array from `offset` on; not checked."""

    def store(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.store(args[2], pointer_to(lane_type, context, builder, signature, args), align=lane_type.align)
            return context.get_dummy_value()

        return types.none(array, types.intp, lane_type), generate

    return intrinsic(store)


def fold_of(lane_type: LaneType, emit: Emit) -> Any:
    """The intrinsic that brings all lanes to one number by `emit(builder, low, high)`, halves first."""

    def fold(typing_context: Any, a: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            value, width = args[0], lane_type.count
            while width > 1:
                width //= 2
                index = ir.VectorType(ir.IntType(32), width)
                low = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width))))
                high = builder.shuffle_vector(value, value, ir.Constant(index, list(range(width, 2 * width))))
                value = emit(builder, low, high)
            return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

        return lane_type.element(lane_type), generate

    return intrinsic(fold)
