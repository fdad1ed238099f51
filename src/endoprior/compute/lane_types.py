"""The Numba type of several floats side by side.

LLVM maps such a type to what the processor has (sixteen float32: one register of AVX-512, two of AVX2, four of SSE or
NEON).
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import models, register_model


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
