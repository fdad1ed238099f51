"""Printing lines for the user. All text that the program prints goes through here, and is made printable.

Notes are such lines: most say what was decided, some ask the user for an action.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from ..core.checks import input_error, printable

INFORMS = "note: "
"""What begins the line of a note that asks for no action."""
ASKS = "to do: "


def say(text: str) -> None:
    """Print one line on stdout and flush it. If its reader has gone, `head` for instance, the work still goes on."""
    try:
        print(printable(text), flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # where all later lines go
        if not isinstance(error, BrokenPipeError):  # a disk that is full or broken
            got = error.strerror or str(error)
            raise input_error("standard output", "a file that takes text", got, "free space, then repeat.") from error


def complain(text: str, end: str = "\n") -> None:
    """Print text on stderr; where there is no reader, it is lost."""
    with suppress(OSError):
        print(printable(text), end=end, file=sys.stderr, flush=True)


def complete_streams() -> None:
    """Give a process that was started without stdin, stdout or stderr (`2>&-`, a service) ones that lead nowhere.

    Without them the next file that is opened would get their number, and the messages of libraries in C.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # in this order: the lowest number is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


class ToDo(str):
    """A note that asks the user for an action."""

    __slots__ = ()


def note_line(note: str) -> str:
    """The line that says a note."""
    return f"{ASKS if isinstance(note, ToDo) else INFORMS}{note}"


def asks_for_action(line: str) -> bool:
    """Whether a line of a step is to be read: a result, a warning, or a note that asks for an action."""
    return not line.startswith(INFORMS)
