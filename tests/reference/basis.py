"""Temporal basis functions, one at a time."""

from __future__ import annotations


def spline_weights(time: float, count: int) -> list[float]:
    """Uniform cubic B-splines on [0, 1] by the recursion of Cox and de Boor, knots a span apart from -3 spans on."""
    span = 1 / (count - 3)

    def value(b: int, degree: int) -> float:
        first = (b - 3) * span
        if degree == 0:
            return float(first <= time < first + span)
        rise = (time - first) / (degree * span) * value(b, degree - 1)
        fall = (first + (degree + 1) * span - time) / (degree * span) * value(b + 1, degree - 1)
        return rise + fall

    return [value(b, 3) for b in range(count)]


def frame_weights(time: float, count: int) -> list[float]:
    """1 at the frame's time, 0 at the times of the frames beside it, linear in between."""
    return [max(0.0, 1 - abs(time - f / count) * count) for f in range(count)]
