"""One line of the report, and a GPU backend: the lines that must be ok for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "missing", "wrong", "optional"]
"""`optional`: not there, and only needed for what the line names."""
Part = Literal["machine", "cuda", "triton", "gsplat", "also"]


@dataclass(frozen=True)
class Line:
    """One thing, whether it is ok, and how to fix it."""

    part: Part
    name: str
    state: State
    found: str
    fix: str = ""
    """A command, or a sentence where no command will do; empty if there is nothing to do, or it would not help."""


@dataclass(frozen=True)
class GpuBackend:
    """What a backend needs besides the GPU itself and torch."""

    needs: tuple[Line, ...]
    """In the order in which they must be ok."""

    @property
    def blocking(self) -> Line | None:
        """The first line that is not ok; None if all are."""
        return next((line for line in self.needs if line.state != "ok"), None)

    @property
    def effort(self) -> tuple[bool, int]:
        """For comparing: whether something has no fix, then how many fixes are needed."""
        wrong = [line for line in self.needs if line.state != "ok"]
        return any(not line.fix for line in wrong), len(wrong)
