"""Parse command-line arguments into dataclasses with tyro; usage errors become one line."""

from __future__ import annotations

import contextlib
import difflib
import inspect
import io
import re
from collections.abc import Collection, Mapping
from typing import TypeVar

import tyro

from ..core.checks import InputError, input_error
from ..core.config_io import current_value
from .help_page import PLAIN, Help, help_page
from .options import Option, options
from .progress import say

A = TypeVar("A")
BOX_DRAWING = re.compile(r"[\u2500-\u257f]+")


def parse(cls: type[A], argv: list[str], command: str, page: Help = PLAIN, default: A | None = None) -> A:
    """Fill the dataclass `cls` from `argv`; `--help` and `--help-all` print a page and exit with status 0.

    Args:
        page: short names of options, and what `--help` shows.
        default: an instance with the defaults; None takes those of the class.
    Raises:
        InputError: an unknown option, a missing argument, or a value of the wrong kind or range.
    """
    arguments = options(cls, default)
    if asked := {"-h", "--help", "--help-all"} & set(argv):
        say(help_page(command, inspect.getdoc(cls), arguments, page, everything="--help-all" in asked))
        raise SystemExit(0)
    if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in argv):
        fix = "Set the shell variable, or remove the empty argument."
        raise input_error(f"endoprior {command}", "no empty argument", "one", fix)
    _reject_unknown(argv, command, {*page.short, *(name for option in arguments for name in option.names)})
    words, errors = _current(argv, page.short), io.StringIO()
    extra = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(cls, args=words, prog=f"endoprior {command}", add_help=False, **extra)
    except SystemExit:
        raise _usage_error(_one_line(errors.getvalue()), argv, arguments, command, page.short) from None
    except InputError:
        raise
    except ValueError as error:  # a range check of the config
        raise InputError(f"{str(error).removesuffix('.')}. Fix: `endoprior {command} --help`.") from None


def _reject_unknown(argv: list[str], command: str, names: Collection[str]) -> None:
    """Raise InputError for the first option that is not in `names`, with the most similar one."""
    for word in argv:
        name = _name(word)
        if not name.startswith("--") or name in names:
            continue
        by_last_part = {each.rpartition(".")[2].removeprefix("--"): each for each in names}
        last = name.rpartition(".")[2].removeprefix("--")
        similar = [last] if last in by_last_part else difflib.get_close_matches(name, names, 1)
        similar = similar or difflib.get_close_matches(last, by_last_part, 1)
        meant = f"Did you mean {by_last_part.get(similar[0], similar[0])}? " if similar else ""
        fix = f"{meant}`endoprior {command} --help-all` lists all options."
        raise input_error(f"endoprior {command}", "an option that it has", name, fix)


def _name(word: str) -> str:
    """The name of an option, without a value behind `=`; underscores are hyphens, as tyro has it."""
    return word.partition("=")[0].replace("_", "-")


def _current(argv: list[str], short: Mapping[str, str]) -> list[str]:
    """The words with short names written out, and values of earlier versions replaced by what they are called now."""
    words: list[str] = []
    for word in argv:
        _, equals, value = word.partition("=")
        option = short.get(_name(word), _name(word)).removeprefix("--")
        if word.startswith("--") and equals:
            words.append(f"--{option}={current_value(option, value, hint=True)}")
        elif word.startswith("--"):
            words.append(f"--{option}")
        else:
            words.append(current_value(words[-1].removeprefix("--") if words else "", word, hint=True))
    return words


def _usage_error(
    text: str, argv: list[str], arguments: Collection[Option], command: str, short: Mapping[str, str]
) -> InputError:
    """The error for what tyro says of a missing argument, one too many, or a value that does not suit its option."""
    fix, places = f"`endoprior {command} --help`.", [each.name for each in arguments if each.is_positional]
    if "Missing from" in text:
        missing = [name for name in places if re.search(rf"\b{re.escape(name)}\b", text)]
        return input_error(f"endoprior {command}", " ".join(places), f"no {' and no '.join(missing)}", fix)
    if "Unrecognized options: " in text:
        expected = " ".join(places) or "options only"
        return input_error(f"endoprior {command}", expected, text.partition("Unrecognized options: ")[2], fix)
    for word, value in zip(argv, [*argv[1:], ""], strict=True):
        for option in arguments:
            if short.get(_name(word), _name(word)) in option.names and re.search(rf"{re.escape(option.name)}\b", text):
                got = word.partition("=")[2] or value
                return input_error(_name(word), _in_words(option.metavar), repr(got) if got else "nothing", fix)
    return InputError(f"{text.rpartition('Error parsing ')[2]}. Fix: {fix}")


def _in_words(metavar: str) -> str:
    """What a value must be."""
    if metavar.startswith("{"):
        return f"one of {', '.join(metavar.strip('{}').split(','))}"
    return {"": "no value", "INT": "an integer", "FLOAT": "a number", "PATH": "a path"}.get(metavar, metavar)


def _one_line(page: str) -> str:
    """The error in tyro's framed page, without the frame, its title and the closing advice."""
    body = [BOX_DRAWING.sub(" ", line).strip() for line in page.splitlines() if not line.startswith("\u256d")]
    text = " ".join(" ".join(body).split("For full helptext")[0].split())
    return text.rstrip(". ")
