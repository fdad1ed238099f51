"""One grammar for every complaint: what was expected, what was found, what to do next."""

from __future__ import annotations

from typing import Any


class InputError(ValueError):
    """The caller's data or options cannot be used. The command line prints it as one line and exits with status 2."""


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
