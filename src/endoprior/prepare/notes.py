"""Notes of `prepare`: most say what was decided, some ask the user for an action."""

from __future__ import annotations

INFORMS = "note: "
"""What begins the line of a note that asks for no action."""
ASKS = "to do: "


class ToDo(str):
    """A note that asks the user for an action."""

    __slots__ = ()


def note_line(note: str) -> str:
    """The line that says a note."""
    return f"{ASKS if isinstance(note, ToDo) else INFORMS}{note}"


def asks_for_action(line: str) -> bool:
    """Whether a line of a step is to be read: a result, a warning, or a note that asks for an action."""
    return not line.startswith(INFORMS)
