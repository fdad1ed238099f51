"""Choose a few items, evenly spaced, of many."""

from __future__ import annotations

import numpy as np


def spread(count: int, wanted: int) -> list[int]:
    """At most `wanted` different positions of 0..count-1, ascending and evenly spaced, both ends included."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, wanted)).round()})
