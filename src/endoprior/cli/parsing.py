"""Parse command-line arguments into dataclasses with tyro; usage errors become one line."""

from __future__ import annotations

import contextlib
import io
import re
from typing import TypeVar

import tyro

from ..core.checks import InputError, input_error
from ..core.config_io import current_value

A = TypeVar("A")
BOX_DRAWING = re.compile(r"[\u2500-\u257f]+")


def parse(cls: type[A], argv: list[str], command: str, default: A | None = None) -> A:
    """Fill the dataclass `cls` from `argv`; `--help` prints and exits with status 0.

    Raises:
        InputError: an unknown option, a missing argument, or a value of the wrong kind or range.
    """
    if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in argv):
        fix = "Set the shell variable, or remove the empty argument."
        raise input_error(f"endoprior {command}", "no empty argument", "one", fix)
    errors = io.StringIO()
    extra = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(cls, args=_current(argv), prog=f"endoprior {command}", description=cls.__doc__, **extra)
    except SystemExit as exit_:
        if exit_.code == 0:
            raise
        raise InputError(f"{_one_line(errors.getvalue())}. Fix: `endoprior {command} --help`.") from None
    except InputError:
        raise
    except ValueError as error:  # a range check of the config
        raise InputError(f"{str(error).removesuffix('.')}. Fix: `endoprior {command} --help`.") from None


def _current(argv: list[str]) -> list[str]:
    """The words with values of earlier versions replaced: `--render.backend cpu` is `--render.backend numba`."""
    words = []
    for word, before in zip(argv, ["", *argv], strict=False):
        option, equals, value = word.partition("=")
        if equals:
            words.append(f"{option}={current_value(option.removeprefix('--'), value, hint=True)}")
        else:
            words.append(current_value(before.removeprefix("--"), word, hint=True))
    return words


def _one_line(page: str) -> str:
    """The error in tyro's framed page, without the frame, its title and the closing advice."""
    body = [BOX_DRAWING.sub(" ", line).strip() for line in page.splitlines() if not line.startswith("\u256d")]
    text = " ".join(" ".join(body).split("For full helptext")[0].split())
    return text.rstrip(". ")
