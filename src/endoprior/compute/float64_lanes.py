"""Eight float64 side by side, as a Numba type, with masks that are plain bytes (bit l is lane l).

Every operation rounds once, so that results equal those of the same formula in NumPy, bit for bit.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from .lane_types import LaneType, add_operators, choose, elementwise, fold_of, load_of, splat_of, store_of

LANES = 8
lanes = LaneType(types.float64, LANES)
add_operators(lanes)


def _compare(relation: str) -> Any:
    """An intrinsic of two vectors that returns the byte of lanes where the relation holds; it never does for NaN."""
    byte = ir.IntType(LANES)
    emit = lambda builder, a, b: builder.bitcast(builder.fcmp_ordered(relation, a, b), byte)  # noqa: E731
    return elementwise(lanes, 2, emit, types.uint8)


splat, load, store = splat_of(lanes), load_of(lanes), store_of(lanes)
larger = elementwise(lanes, 2, choose(">"))
less, equal = _compare("<"), _compare("==")
largest = fold_of(lanes, choose(">"))
"""The largest lane."""


@intrinsic
def pick(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """`a` in the lanes of the mask, `b` in the others."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.bitcast(args[0], ir.VectorType(ir.IntType(1), LANES)), args[1], args[2])

    return lanes(types.uint8, lanes, lanes), generate
