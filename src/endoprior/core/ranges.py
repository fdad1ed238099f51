"""Ranges of the numbers in a config: part of a field's type, checked when it is made. And evenly spaced numbers."""

from __future__ import annotations

import functools
import typing
from collections import namedtuple
from typing import Annotated

import numpy as np

from .checks import check_range

Range = namedtuple("Range", "low high")
"""Both ends are allowed, NaN is not. Of a tuple every element is meant."""
Count = Annotated[int, Range(0, 10_000_000)]
Positive = Annotated[int, Range(1, 10_000_000)]
Share = Annotated[float, Range(0, 1)]
Weight = Annotated[float, Range(0, 1e6)]
Threshold = Annotated[float, Range(-1e3, 1e3)]
Rate = Annotated[float, Range(0, 1e3)]
DecayedRate = Annotated[float, Range(1e-30, 1e3)]  # its logarithm is taken


@functools.cache
def _ranges(cls: type) -> dict[str, Range]:
    """The ranges in the annotations of a config's fields."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}


class Checked:
    """A config that rejects values outside the ranges of its fields."""

    def __post_init__(self) -> None:
        for name, allowed in _ranges(type(self)).items():
            value = getattr(self, name)
            for part in value if isinstance(value, tuple | list) else (value,):
                check_range(name, part, *allowed)


def evenly_spaced(count: int, wanted: int) -> list[int]:
    """At most `wanted` different positions of 0..count-1, ascending and evenly spaced, both ends included."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, wanted)).round()})
