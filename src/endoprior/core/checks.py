"""One grammar for every complaint: what was expected, what was found, what to do next."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


class InputError(ValueError):
    """The caller's data or options cannot be used. The command line prints it as one line and exits with status 2."""


def runs(numbers: Iterable[int], most: int = 8) -> str:
    """Ascending numbers in words: `3-5, 9` of 3, 4, 5, 9, and how many runs there are beyond `most`."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    words = ", ".join(f"{first}" if first == last else f"{first}-{last}" for first, last in found[:most])
    return words + (f" and {len(found) - most} more places" if len(found) > most else "")


def check_shape(spec: str, **arrays: Any) -> dict[str, int]:
    """Match array shapes against a spec such as ``"means:N,3 quats:N,4"`` and return the sizes it bound.

    Raises:
        ValueError: a shape differs from its spec, or one letter would stand for two sizes.
    """
    sizes: dict[str, int] = {}
    for item in spec.split():
        name, dims = item.split(":")
        want, got = dims.split(","), tuple(arrays[name].shape)
        matches = len(want) == len(got) and all(
            (int(w) if w.isdigit() else sizes.setdefault(w, g)) == g for w, g in zip(want, got, strict=True)
        )
        if not matches:
            raise ValueError(f"{name} must have shape ({dims}); got {got} where {sizes or 'nothing is bound yet'}")
    return sizes


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError unless low <= value <= high (NaN fails)."""
    if not low <= value <= high:
        raise ValueError(f"{name} must be in [{low:g}, {high:g}]; got {value!r}")
