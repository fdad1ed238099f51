"""Parse command-line arguments into dataclasses with tyro."""

from __future__ import annotations

import contextlib
import inspect
import io
from collections.abc import Mapping
from typing import TypeVar

import tyro

from ..core.checks import InputError, input_error
from ..system.console import say
from .help_page import PLAIN, Help, help_page
from .options import option_name, options
from .usage_errors import reject_unknown, usage_error

A = TypeVar("A")


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
    reject_unknown(argv, command, [*page.short, *(name for option in arguments for name in option.names)])
    words, errors = _written_out(argv, page.short), io.StringIO()
    extra = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(cls, args=words, prog=f"endoprior {command}", add_help=False, **extra)
    except SystemExit:
        raise usage_error(errors.getvalue(), argv, command, arguments, page.short) from None
    except InputError:
        raise
    except ValueError as error:  # a range check of the config
        raise InputError(f"{str(error).removesuffix('.')}. Fix: `endoprior {command} --help`.") from None


def _written_out(argv: list[str], short: Mapping[str, str]) -> list[str]:
    """The words with short names of options written out."""
    words: list[str] = []
    for word in argv:
        _, equals, value = word.partition("=")
        option = short.get(option_name(word), option_name(word)).removeprefix("--")
        words.append(f"--{option}{equals}{value}" if word.startswith("--") else word)
    return words
