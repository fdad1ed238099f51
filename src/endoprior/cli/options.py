"""The options of a command, read from its dataclass the way tyro reads them when it parses."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from typing import Any, get_args

from tyro.conf import Positional
from tyro.constructors import MISSING, MISSING_NONPROP, ConstructorRegistry, PrimitiveTypeInfo, StructTypeInfo


@dataclass(frozen=True)
class Option:
    """One option or positional argument of a command."""

    name: str
    """As it is typed: `--init.budget`. Of a positional argument what the usage line calls it: `OUT`."""
    metavar: str
    """What stands for the value: `INT`, `{auto,cpu,cuda}`; empty for a flag, which takes none."""
    default: Any
    """Its value if it is not given."""
    text: str
    """Its explanation: the docstring of the field."""
    section: str
    """Dotted name of the part of the config that it belongs to: `init`; empty for the command's own."""
    about: str
    """The first line of that part's docstring."""

    @property
    def is_positional(self) -> bool:
        """Whether it is given by its place."""
        return not self.name.startswith("-")

    @property
    def is_required(self) -> bool:
        """Whether the command does not run without it."""
        return self.default is MISSING or self.default is MISSING_NONPROP

    @property
    def is_flag(self) -> bool:
        """Whether it is switched on and off, and takes no value."""
        return not self.metavar

    @property
    def off(self) -> str:
        """The name that switches a flag off: `--no-networks`, `--init.no-cleanup`."""
        path, dot, last = self.name.removeprefix("--").rpartition(".")
        return f"--{path}{dot}no-{last}"

    @property
    def names(self) -> tuple[str, ...]:
        """Every name that tyro accepts."""
        return (self.name, self.off) if self.is_flag else (self.name,)


def option_name(word: str) -> str:
    """The name of an option as it is typed, without a value behind `=`; underscores are hyphens, as tyro has it."""
    return word.partition("=")[0].replace("_", "-")


def options(cls: type, default: Any = None) -> list[Option]:
    """Every argument of the command `cls`, in the order of its fields.

    Args:
        default: an instance with the defaults; None takes those of the class.
    """
    return list(_walk(cls, MISSING_NONPROP if default is None else default, "", ""))


def _walk(cls: type, default: Any, section: str, about: str) -> Iterator[Option]:
    spec = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(cls, default, in_union_context=False))
    for field in spec.fields:
        named = {key: value for part in _extras(field.type) for key, value in getattr(part, "__dict__", {}).items()}
        name = field.name if named.get("name") is None else named["name"]
        path = ".".join(part for part in (section, name.replace("_", "-")) if part)
        kind = field.type.__origin__ if _extras(field.type) else field.type
        if is_dataclass(kind):
            yield from _walk(kind, field.default, path, inspect.getdoc(kind).splitlines()[0])
            continue
        text = named.get("help") or (field.helptext() if callable(field.helptext) else field.helptext)
        found = {"default": field.default, "text": " ".join((text or "").split()), "section": section, "about": about}
        if Positional in _extras(field.type):
            yield Option(named["metavar"], named["metavar"], **found)
        else:
            yield Option(f"--{path}", named.get("metavar") or _metavar(kind), **found)


def _extras(annotation: Any) -> tuple[Any, ...]:
    """What `Annotated` adds to a type."""
    return getattr(annotation, "__metadata__", ())


def _metavar(kind: Any) -> str:
    """What tyro shows for a value of this type, without the None that stands for "not given"."""
    if kind is bool:
        return ""
    if type(None) in get_args(kind):
        kind = get_args(kind)[0]
    metavar = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set())).metavar
    return re.sub(r"^\[(.*) \[\1 \.\.\.\]\]$", r"\1 ...", metavar)
