"""The arguments of a command: its dataclass as options of argparse, as a help page, and filled from what was typed.

A field `first_frames` of the part `data` is `--data.first-frames`, and its docstring is its help. Metadata of a field:
`place` is what the usage line calls an argument that is given by its place; `name`, `metavar` and `choices` replace
those that follow from name and type. The fields of a part with the name "" are options of the command itself.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from argparse import SUPPRESS, ArgumentParser, HelpFormatter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache, partial
from itertools import pairwise, takewhile
from types import NoneType
from typing import Any, ClassVar, Literal, NoReturn, Self, TypeVar, get_args, get_origin, get_type_hints

from ..core.checks import InputError, input_error, or_did_you_mean, quotation, similar_name
from ..core.shell import quoted
from ..system.console import say

A = TypeVar("A")
C = TypeVar("C", bound="Command")
UNKNOWN, REQUIRED = "unrecognized arguments: ", "the following arguments are required: "
"""Messages of argparse, before what they name."""
WRONG_CHOICE = re.compile(r"argument ([^\s/]+): invalid choice: '(.*)' \(choose from (.*)\)")
"""A message of argparse: option, what was typed, and the choices."""


class Command:
    """A command: a dataclass whose fields are its arguments, and what its help page shows besides them."""

    examples: ClassVar[tuple[str, ...]] = ()
    """Arguments of example commands."""
    basics: ClassVar[str] = ""
    """Names of options, as they are typed. `--help` shows these; empty shows all options."""
    short: ClassVar[Mapping[str, str]] = {}
    """Short name -> the option it stands for: `--iterations` -> `--schedule.fine-iterations`."""

    @classmethod
    def more_help(cls) -> list[str]:
        """Lines of the help page below the options."""
        return []

    @classmethod
    def from_words(cls, argv: Sequence[str]) -> Self:
        """The command with the arguments that were typed; see `parse`."""
        return parse(cls, argv, cls.__name__.lower())

    def execute(self) -> int | None:
        """Do it; returns the exit status, or None for 0."""
        raise NotImplementedError


@dataclass(frozen=True)
class Option:
    """One option or positional argument of a command."""

    path: str
    """Of its field: `config.init.budget`."""
    name: str
    """As it is typed: `--init.budget`; of a positional argument what the usage line calls it: `OUT`."""
    kind: Any
    """Type of a value, without the None that stands for "not given"."""
    default: Any
    """Its value if it is not given; MISSING if it must be."""
    text: str
    section: str
    """Dotted name of the part of the config that it belongs to: `init`; empty for the command's own."""
    about: str | None
    """What that part is."""
    metavar: str | None = None
    """What stands for the value on the help page; None takes the type."""
    choices: Sequence[str] | None = None

    @property
    def is_positional(self) -> bool:
        """Whether it is given by its place."""
        return not self.name.startswith("-")

    @property
    def off(self) -> str:
        """The name that switches a flag off: `--no-networks`, `--init.no-cleanup`."""
        head, dot, last = self.name.removeprefix("--").rpartition(".")
        return f"--{head}{dot}no-{last}"

    @property
    def usual_name(self) -> str:
        """The name to show: of a flag that is on, the one that switches it off."""
        return self.off if self.default is True else self.name

    def names(self, command: type[Command]) -> list[str]:
        """Every name that can be typed."""
        short = [short for short, name in command.short.items() if name == self.name]
        return [self.name, *short, *([self.off] if self.kind is bool else [])]

    def help(self, brief: bool) -> str:
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


def parse(cls: type[C], argv: Sequence[str], command: str, **defaults: Any) -> C:
    """Fill `cls` from `argv`, with `defaults`; `--help` and `--help-all` print a page and exit with status 0."""
    arguments, everything = list(options(cls, defaults)), "--help-all" in argv or not cls.basics
    parser = parser_of(cls, command, arguments, everything)
    if {"-h", "--help", "--help-all"} & set(argv):
        examples = "".join(f"\n  endoprior {command} {words}".rstrip() for words in cls.examples)
        count = sum(not each.is_positional for each in arguments)
        listed = "" if everything else f"\n\n--help-all lists all {count} options."
        more = "".join(f"\n{line}" for line in ["", *cls.more_help()]) if cls.more_help() else ""
        say(parser.format_help().rstrip() + more + (f"\n\nexamples:{examples}" if examples else "") + listed)
        raise SystemExit(0)
    if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in argv):
        fix = "Set the shell variable, or remove the empty argument."
        raise input_error(f"endoprior {command}", "no empty argument", "one", fix)
    words = [option_name(word) + word[len(option_name(word)) :] if word.startswith("--") else word for word in argv]
    parser.typed = words
    given = vars(parser.parse_intermixed_args(words))
    try:
        return _filled(cls, defaults, {path: value for path, value in given.items() if value is not None})
    except InputError:
        raise
    except ValueError as error:  # a range check of the config; its message starts with the name of the field
        paths = {name: f".{each.path}" for each in arguments for name in each.names(cls)}
        at_fault = f".{str(error).partition(' ')[0]}"
        named = [name for name in map(option_name, words) if paths.get(name, "").endswith(at_fault)]
        message = ": ".join([*named[:1], str(error).removesuffix(".")])
        raise InputError(f"{message}. Fix: `endoprior {command} --help`.") from None


def options(cls: type, defaults: Mapping[str, Any], path: str = "", section: str = "") -> Iterator[Option]:
    """Every argument of the command `cls`; `path` and `section` stand in front of the names of fields and options."""
    kinds, texts = get_type_hints(cls), _texts(cls)
    about = (inspect.getdoc(cls) or "").partition("\n")[0] if section else None
    for each in fields(cls):
        kind, default, facts = kinds[each.name], _default(each, defaults), dict(each.metadata)
        dotted = ".".join(filter(None, (section, facts.pop("name", each.name.replace("_", "-")))))
        if is_dataclass(default):
            yield from options(type(default), vars(default), f"{path}{each.name}.", dotted)
            continue
        kind = get_args(kind)[0] if NoneType in get_args(kind) else kind
        name, text = facts.pop("place", f"--{dotted}"), texts.get(each.name, "")
        yield Option(path + each.name, name, kind, default, text, section, about, **facts)


class Parser(ArgumentParser):
    """A parser whose errors are those of this program."""

    typed: Sequence[str] = ()
    """What it is to parse."""

    def error(self, message: str) -> NoReturn:
        known, unknown = list(self._option_string_actions), message.removeprefix(UNKNOWN).split()
        if message.startswith(REQUIRED):  # an option with another name may be why something is missing
            unknown = [word for word in self.typed if word.startswith("--") and option_name(word) not in known]
            message = UNKNOWN + " ".join(unknown) if unknown else message
        fix = f"`{self.prog} --help-all` lists all options"
        if message.startswith(REQUIRED):
            fix = f"`{self.with_missing(message.removeprefix(REQUIRED).split(', '))}`; {fix}"
        if message.startswith(UNKNOWN):
            mistyped = next((option_name(word) for word in unknown if word.startswith("-")), "")
            fix = or_did_you_mean(f"{fix}.", mistyped, known)
            raise InputError(f"{self.prog}: {quotation(message)}. Fix: {fix}")
        if choice := WRONG_CHOICE.match(message):
            name, typed, known = choice.groups()
            nearest = similar_name(typed, known.replace("'", "").split(", "))
            shown = f"{name} {nearest}" if name.startswith("-") else f"{self.prog} {nearest}"
            others = f"{fix}; `endoprior plugins` lists the presets of other packages"
            fix = f"`{shown}`" if nearest else others if name == "--preset" else fix
        raise InputError(f"{self.prog}: {quotation(message.removeprefix('argument '))}. Fix: {fix}.")

    def with_missing(self, missing: Sequence[str]) -> str:
        """The command with the places that were not given, behind those that were if these stand first."""
        places = [str(action.metavar) for action in self._get_positional_actions()]
        given = [*takewhile(lambda word: not word.startswith("-"), self.typed)]
        known = places.index(missing[0])
        return " ".join([self.prog, *(map(quoted, given) if len(given) == known else places[:known]), *missing])


def parser_of(cls: type[Command], command: str, arguments: Sequence[Option], everything: bool) -> Parser:
    """A parser that takes all arguments, and whose help shows all or the basic ones."""
    places = [each.name if each.default is MISSING else f"[{each.name}]" for each in arguments if each.is_positional]
    rest = ["[options]"] if len(arguments) > len(places) else []
    parser = Parser(
        prog=f"endoprior {command}",
        usage=" ".join([f"endoprior {command}", *places, *rest]),
        description=(inspect.getdoc(cls) or "").replace("%", "%%"),
        add_help=False,
        allow_abbrev=False,
        argument_default=SUPPRESS,
        formatter_class=partial(HelpFormatter, max_help_position=28),
    )
    basics, groups = cls.basics.split(), {}
    for each in arguments:
        text = each.help(brief=not (everything or each.is_positional))
        if each.is_positional:
            count = None if each.default is MISSING else "?"
            choices = get_args(each.kind) if get_origin(each.kind) is Literal else None
            about = {"metavar": each.name, "help": text, "nargs": count, "default": None}
            parser.add_argument(each.path, choices=choices, type=str if choices else each.kind, **about)
            continue
        if everything and each.section not in groups:
            groups[each.section] = parser.add_argument_group(f"{each.section} options".strip(), each.about)
        group = groups.get(each.section, parser)
        for name in each.names(cls):
            shown = name == each.usual_name if everything else name in basics
            group.add_argument(name, dest=each.path, help=text if shown else SUPPRESS, **_taken(each, name))
    return parser


def _taken(option: Option, name: str) -> dict[str, Any]:
    """The words after a name of an option, for argparse."""
    if option.kind is bool:
        return {"action": "store_false" if name == option.off else "store_true"}
    if option.choices or get_origin(option.kind) is Literal:
        return {"choices": option.choices or get_args(option.kind), "metavar": option.metavar}
    kind, count, action = option.kind, None, "store"
    if get_origin(kind) is tuple:
        kind, *others = get_args(kind)
        count, action = ("*", "extend") if others == [...] else (1 + len(others), "store")  # given again: more values
    return {"action": action, "type": kind, "nargs": count, "metavar": option.metavar or kind.__name__.upper()}


def _default(one: Field, defaults: Mapping[str, Any]) -> Any:
    """The value of a field if nothing is typed; MISSING if there is none."""
    if one.name in defaults or one.default_factory is MISSING:
        return defaults.get(one.name, one.default)
    return one.default_factory()


def _filled(cls: type[A], defaults: Mapping[str, Any], given: Mapping[str, Any], path: str = "") -> A:
    """An instance with the values of `given`, by the paths of fields, and defaults elsewhere."""
    values = {}
    for each in fields(cls):  # pyright: ignore[reportArgumentType]
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
        (made,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(made, ast.ClassDef)
        for statement, after in pairwise(made.body):
            if isinstance(statement, ast.AnnAssign) and isinstance(after, ast.Expr):
                texts[ast.unparse(statement.target)] = " ".join(ast.literal_eval(after.value).split())
    return texts
