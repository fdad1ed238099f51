"""Convert configs to and from JSON: all fields are written, unknown ones are rejected."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from .checks import InputError, input_error, similar_name

C = TypeVar("C")
_hints = functools.cache(typing.get_type_hints)
SHORT_NAMES = {
    "gaussians": "init.budget",
    "init_budget": "init.budget",
    "trust_masks": "loss.trust_masks",
    "eyes": "data.eyes",
}
"""Short name of a config field -> its dotted name; in Python, in specs and, with dashes, on the command line."""
IN_PROPORTION = (
    "schedule.half_resolution_iterations", "schedule.sh_every", "density.start_iteration", "density.stop_iteration",
    "temporal.start_iteration", "optim.decay_iterations",
)  # fmt: skip
"""What keeps its share of the training when `iterations` changes, unless `schedule.literal`."""
UNKNOWN_FIELD = "Correct the name, or use the version of endoprior that wrote it."
FACTOR = re.compile(r"x([0-9]+(?:\.[0-9]+)?)")


def to_dict(cfg: Any) -> Any:
    """Nested dict of every field of a config dataclass; tuples become lists, as in JSON."""
    if dataclasses.is_dataclass(cfg):
        return {field.name: to_dict(getattr(cfg, field.name)) for field in dataclasses.fields(cfg)}
    if isinstance(cfg, dict):
        return {key: to_dict(value) for key, value in cfg.items()}
    return [to_dict(value) for value in cfg] if isinstance(cfg, tuple | list) else cfg


def override(values: dict[str, Any], changes: Mapping[str, Any], where: str) -> None:
    """Set fields of a nested dict from `to_dict` by their dotted or short names; `from_dict` checks the values.

    Args:
        changes: new value by name, such as `init.budget`, or `gaussians` (see `SHORT_NAMES`); a text such as "x0.75"
            multiplies the number that is there. `iterations` is the number of all iterations (`set_iterations`), and
            is changed before the others.
        where: what the error message calls the changes.
    Raises:
        InputError: no field has this name; the message proposes the nearest one.
    """
    for name, value in sorted(changes.items(), key=lambda change: change[0] != "iterations"):
        if name == "iterations" and name not in values and "schedule" in values:
            set_iterations(values, value)
            continue
        full = name if name in values else SHORT_NAMES.get(name, name)  # a plugin's options can have such a field
        *path, last = str(full).split(".")
        group: Any = values
        for part in path:
            group = group.get(part) if isinstance(group, dict) else None
        if not isinstance(group, dict) or last not in group or isinstance(group[last], dict):
            names = _dotted_names(values)
            short = [s for s, of in SHORT_NAMES.items() if of in names]
            nearest = similar_name(str(name), ["iterations", *short, *names])
            fix = f"use `{nearest}`." if nearest else "see `endoprior train --help-all`."
            raise input_error(where, "the name of a config field", str(name), fix)
        group[last] = _multiplied(group[last], value)


def set_iterations(values: dict[str, Any], wanted: Any) -> None:
    """Make the training that long in a nested dict from `to_dict`: both stages together, each with its share.

    Growth, the temporal term, full resolution and the decay of rates keep their places as shares of the length; those
    of a literal schedule keep their numbers.

    Args:
        wanted: the number of all iterations, above 0, or a text such as "x0.5".
    Raises:
        InputError: it is no such number.
    """
    schedule = values["schedule"]
    coarse, before = schedule["coarse_iterations"], schedule["coarse_iterations"] + schedule["fine_iterations"]
    total = _multiplied(before, wanted)
    if type(total) is not int or total < 1:
        raise input_error("iterations", "a whole number above 0", f"{wanted!r}", "choose one.")
    schedule["coarse_iterations"] = min(round(coarse * total / before), total - 1)
    schedule["fine_iterations"] = total - schedule["coarse_iterations"]
    if not schedule["literal"]:
        for name in IN_PROPORTION:
            group, _, field = name.partition(".")
            least = min(values[group][field], 1)
            values[group][field] = max(round(values[group][field] * total / before), least)


def _multiplied(number: Any, value: Any) -> Any:
    """The value, or the number times that of a text such as "x0.75"."""
    if isinstance(value, str) and (factor := FACTOR.fullmatch(value)) and type(number) in (int, float):
        return type(number)(number * float(factor[1]))
    return value


def _dotted_names(values: dict[str, Any], prefix: str = "") -> list[str]:
    names = []
    for name, value in values.items():
        names += _dotted_names(value, f"{prefix}{name}.") if isinstance(value, dict) else [f"{prefix}{name}"]
    return names


def from_dict(cls: type[C], values: Any, where: str = "config") -> C:
    """Build a config dataclass from a nested dict. Unknown fields and wrong types are errors; missing ones default.

    Numbers must be finite, which Python's JSON reader does not ask for.

    Raises:
        InputError: names the field, the expected and the actual value.
    """
    if not isinstance(values, dict):
        fix = "Use a file written by endoprior."
        raise input_error(where, "an object with fields", type(values).__name__, fix)
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType] - cls is a dataclass
    hints = {field.name: _hints(cls)[field.name] for field in fields}
    unknown = sorted(map(str, set(values) - set(hints)))
    if unknown:
        name = unknown[0] if unknown[0].isidentifier() else repr(unknown[0])
        raise input_error(f"{where}.{name[:80]}", f"one of {', '.join(hints)}", "no such field", UNKNOWN_FIELD)
    needed = [f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING]
    if missing := [name for name in needed if name not in values]:
        raise input_error(f"{where}.{missing[0]}", "an entry", "none", "add it.")
    built = {name: value_of(hints[name], value, f"{where}.{name}") for name, value in values.items()}
    try:
        return cls(**built)
    except ValueError as error:
        fix = "" if isinstance(error, InputError) else ". Fix: Correct the value."
        raise InputError(f"{where}: {error}{fix}") from error


def value_of(hint: Any, value: Any, where: str) -> Any:
    """The value as its type wants it: lists become tuples, dicts dataclasses. InputError about `where` otherwise."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType and any(map(dataclasses.is_dataclass, args)):
        if value is None:
            return None
        hint, origin = next(filter(dataclasses.is_dataclass, args)), None
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return value if isinstance(value, hint) else from_dict(hint, value, where)
    ok, want = _fits(hint, origin, args, value)
    if not ok:
        raise input_error(where, want, _shown(value), "Correct the value.")
    if origin is tuple:
        return tuple(value_of(args[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is dict:
        return {key: value_of(args[1], v, f"{where}.{key}") for key, v in value.items()}
    return value


def _fits(hint: Any, origin: Any, args: tuple[Any, ...], value: Any) -> tuple[bool, str]:
    """Whether a value has its type, but for the elements of a container, and what is expected."""
    if origin is typing.Literal:
        return value in args, f"one of {', '.join(map(repr, args))}"
    if origin is tuple:
        any_length = args[-1] is Ellipsis
        fits = isinstance(value, list | tuple) and (any_length or len(value) == len(args))
        return fits, "a list" if any_length else f"a list of {len(args)}"
    if origin is dict:
        return isinstance(value, dict) and all(type(key) is str for key in value), "named entries"
    if origin is types.UnionType:
        return value is None or (any(type(value) is a for a in args) and _is_usable(value)), str(hint)
    numbers = {float: ((int, float), "a finite number"), int: ((int,), "an integer below 2^63")}
    if hint in numbers:
        kinds, want = numbers[hint]
        return type(value) in kinds and _is_usable(value), want
    return hint is Any or type(value) is hint, getattr(hint, "__name__", str(hint))


def _is_usable(value: Any) -> bool:
    """Whether a number is finite, and an integer fits into 64 bits; True for other types."""
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, int) or abs(value) < 2**63


def _shown(value: Any) -> str:
    """A value for a message: one line of at most 80 characters."""
    if isinstance(value, dict | list | tuple):
        return f"{type(value).__name__} of {len(value)}"
    text = "a larger one" if isinstance(value, int) and not _is_usable(value) else repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."
