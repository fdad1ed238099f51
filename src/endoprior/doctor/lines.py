"""One line of the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "missing", "wrong"]
Part = Literal["machine", "cuda", "also"]


@dataclass(frozen=True)
class Line:
    """One thing, whether it is right, and what makes it so."""

    part: Part
    name: str
    state: State
    found: str
    mend: str = ""
    """A command, or a sentence where no command will do; empty if there is nothing to do, or it would not help."""
