"""The arguments of a command: its dataclass as options of argparse, as a help page, and filled from what was typed.

A field `first_frames` of the part `data` is `--data.first-frames`, and its docstring is its help. Metadata of a field:
`place` is what the usage line calls an argument that is given by its place; `name` and `metavar` replace those that
follow from name and type. The fields of a part with the name "" are options of the command itself.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from argparse import SUPPRESS, ArgumentParser, HelpFormatter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from functools import cache, partial
from itertools import pairwise
from types import NoneType
from typing import Any, Literal, NoReturn, TypeVar, get_args, get_origin, get_type_hints

from ..core.checks import InputError, input_error, quotation, similar_name
from ..core.shell import command as shell_command
from ..system.console import say

A = TypeVar("A")


@dataclass(frozen=True)
class Help:
    """What the help page of a command shows besides its options. Stands beside the dataclass of the command."""

    examples: tuple[tuple[str, ...], ...] = ()
    """Words of example commands, after the name of the command."""
    basics: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """What options are for -> their names, as they are typed. `--help` shows these; empty shows all options."""
    short: Mapping[str, str] = field(default_factory=dict)
    """Short name -> the option it stands for: `--iterations` -> `--schedule.fine-iterations`."""


@dataclass(frozen=True)
class Option:
    """One option or positional argument of a command."""

    path: str
    """Of its field: `config.init.budget`."""
    name: str
    """As it is typed: `--init.budget`; of a positional argument what the usage line calls it: `OUT`."""
    kind: Any
    """Type of a value, without the None that stands for "not given"."""
    metavar: str
    """What stands for the value on the help page; empty takes the type."""
    default: Any
    """Its value if it is not given; MISSING if it must be."""
    text: str
    section: str
    """Dotted name of the part of the config that it belongs to: `init`; empty for the command's own."""
    about: str | None
    """What that part is."""

    @property
    def is_positional(self) -> bool:
        """Whether it is given by its place."""
        return not self.name.startswith("-")

    @property
    def off(self) -> str:
        """The name that switches a flag off: `--no-networks`, `--init.no-cleanup`."""
        path, dot, last = self.name.removeprefix("--").rpartition(".")
        return f"--{path}{dot}no-{last}"

    @property
    def usual_name(self) -> str:
        """The name to show: of a flag that is on, the one that switches it off."""
        return self.off if self.default is True else self.name

    def names(self, page: Help) -> list[str]:
        """Every name that can be typed."""
        short = [short for short, name in page.short.items() if name == self.name]
        return [self.name, *short, *([self.off] if self.kind is bool else [])]

    def help(self, brief: bool = False) -> str:
        """Its text, or the first sentence of it, with the default if there is one to show; for argparse."""
        text = re.split(r"(?<=\.)\s", self.text)[0] if brief else self.text
        default = " ".join(map(str, self.default)) if isinstance(self.default, tuple) else self.default
        if self.kind is bool:
            text = f"Switch off: {text}" if default is True else text
        elif default is not MISSING and default not in (None, ""):
            text += f" (default: {default})"
        return text.replace("%", "%%").strip()


def option_name(word: str) -> str:
    """The name of an option without a value behind `=`; underscores count as hyphens."""
    return word.partition("=")[0].replace("_", "-")


def parse(cls: type[A], argv: Sequence[str], command: str, page: Help | None = None, **defaults: Any) -> A:
    """Fill the dataclass `cls` from `argv`; `--help` and `--help-all` print a page and exit with status 0.

    Args:
        page: short names of options, and what `--help` shows.
        defaults: values of fields in place of those of the class.
    Raises:
        InputError: an unknown option, a missing argument, or a value of the wrong kind or range.
    """
    page, arguments, fix = page or Help(), list(options(cls, defaults)), f"`endoprior {command} --help`."
    everything = "--help-all" in argv or not page.basics
    parser = _parser(cls, command, arguments, page, everything)
    if {"-h", "--help", "--help-all"} & set(argv):
        lines = ["", "examples:", *(f"  {shell_command(command, *words)}" for words in page.examples), ""]
        named = sum(not each.is_positional for each in arguments)
        listed = "" if everything else f"--help-all lists all {named} options."
        say("\n".join([parser.format_help().rstrip(), *(lines if page.examples else ()), listed]).rstrip())
        raise SystemExit(0)
    if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in argv):
        empty = "Set the shell variable, or remove the empty argument."
        raise input_error(f"endoprior {command}", "no empty argument", "one", empty)
    words = [option_name(word) + word[len(option_name(word)) :] if word.startswith("--") else word for word in argv]
    typed = [option_name(word) for word in words if word.startswith("--")]
    names = {name: each.path for each in arguments if not each.is_positional for name in each.names(page)}
    for name in typed:
        if name not in names:
            nearest = similar_name(name, list(names))
            meant = f"Did you mean {nearest}? " if nearest else ""
            listed = f"{meant}`endoprior {command} --help-all` lists all options."
            raise input_error(f"endoprior {command}", "an option that it has", name, listed)
    given, more = parser.parse_known_intermixed_args(words)
    if more:
        places = " ".join(each.name for each in arguments if each.is_positional)
        raise input_error(f"endoprior {command}", places or "options only", more[0], fix)
    try:
        return _filled(cls, defaults, {path: value for path, value in vars(given).items() if value is not None})
    except InputError:
        raise
    except ValueError as error:  # a range check of the config
        field_of = {name: names[name].rpartition(".")[2] for name in typed}
        subject = next((f"{name}: " for name in typed if str(error).startswith(f"{field_of[name]} ")), "")
        raise InputError(f"{subject}{str(error).removesuffix('.')}. Fix: {fix}") from None


def options(cls: type, defaults: Mapping[str, Any], path: str = "", section: str = "") -> Iterator[Option]:
    """Every argument of the command `cls`, in the order of its fields.

    Args:
        defaults: values of fields in place of those of the class.
        path, section: in front of the names of fields and of options.
    """
    kinds, texts = get_type_hints(cls), _texts(cls)
    for each in fields(cls):
        kind, default = kinds[each.name], _default(each, defaults)
        name = each.metadata.get("name", each.name.replace("_", "-"))
        dotted = ".".join(filter(None, (section, name)))
        if is_dataclass(default):
            yield from options(type(default), vars(default), f"{path}{each.name}.", dotted)
            continue
        kind = get_args(kind)[0] if NoneType in get_args(kind) else kind
        metavar = each.metadata.get("metavar", "")
        about = inspect.getdoc(cls).splitlines()[0] if section else None
        typed = each.metadata.get("place", f"--{dotted}")
        yield Option(path + each.name, typed, kind, metavar, default, texts.get(each.name, ""), section, about)


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{quotation(message.removeprefix('argument '))}. Fix: `{self.prog} --help`.")


def _parser(cls: type, command: str, arguments: Sequence[Option], page: Help, everything: bool) -> ArgumentParser:
    """A parser that takes all arguments, and whose help shows all or the basic ones."""
    required = {each.name: each.default is MISSING for each in arguments if each.is_positional}
    places = " ".join(name if needed else f"[{name}]" for name, needed in required.items())
    parser = _Parser(
        prog=f"endoprior {command}",
        usage=f"endoprior {command} {places}".rstrip() + (" [options]" if len(arguments) > len(required) else ""),
        description=inspect.getdoc(cls).replace("%", "%%"),
        add_help=False,
        allow_abbrev=False,
        argument_default=SUPPRESS,
        formatter_class=partial(HelpFormatter, max_help_position=28),
    )
    basics = {name: title for title, names in page.basics.items() for name in names}
    groups = {} if everything else {title: parser.add_argument_group(title) for title in page.basics}
    for each in arguments:
        if each.is_positional:
            count = None if required[each.name] else "?"
            how = {"nargs": count, "type": each.kind, "default": None}
            parser.add_argument(each.path, metavar=each.name, help=each.help(), **how)
            continue
        if everything and each.section not in groups:
            groups[each.section] = parser.add_argument_group(f"{each.section} options".strip(), each.about)
        for name in each.names(page):
            shown = name == each.usual_name if everything else name in basics
            group = groups[each.section if everything else basics[name]] if shown else parser
            text = each.help(brief=not everything) if shown else SUPPRESS
            group.add_argument(name, dest=each.path, help=text, **_taken(each, name))
    return parser


def _taken(option: Option, name: str) -> dict[str, Any]:
    """The words after a name of an option, for argparse."""
    if option.kind is bool:
        return {"action": "store_false" if name == option.off else "store_true"}
    if get_origin(option.kind) is Literal:
        return {"choices": get_args(option.kind)}
    if get_origin(option.kind) is tuple:
        kind, *others = get_args(option.kind)
        count = "*" if others == [...] else 1 + len(others)
        return {"type": kind, "nargs": count, "metavar": option.metavar or kind.__name__.upper()}
    return {"type": option.kind, "metavar": option.metavar or option.kind.__name__.upper()}


def _default(one: Field, defaults: Mapping[str, Any]) -> Any:
    """The value of a field if nothing is typed; MISSING if there is none."""
    if one.name in defaults or one.default_factory is MISSING:
        return defaults.get(one.name, one.default)
    return one.default_factory()


def _filled(cls: type[A], defaults: Mapping[str, Any], given: Mapping[str, Any], path: str = "") -> A:
    """An instance with the values of `given`, by the paths of fields, and defaults elsewhere."""
    values = {}
    for each in fields(cls):
        value = _default(each, defaults)
        if is_dataclass(value):
            value = _filled(type(value), vars(value), given, f"{path}{each.name}.")
        value = given.get(path + each.name, value)
        values[each.name] = tuple(value) if isinstance(value, list) else value
    return cls(**values)


@cache
def _texts(cls: type) -> dict[str, str]:
    """The docstrings of the fields of a dataclass, each on one line."""
    texts = {}
    for base in reversed([base for base in cls.__mro__ if is_dataclass(base)]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body
        for statement, after in pairwise(body):
            if isinstance(statement, ast.AnnAssign) and isinstance(after, ast.Expr):
                texts[statement.target.id] = " ".join(ast.literal_eval(after.value).split())
    return texts
