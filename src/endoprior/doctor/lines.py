"""One line of the report, and a way to draw on the GPU: the lines that must be right for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "missing", "wrong"]
Part = Literal["machine", "cuda", "triton", "gsplat", "also"]


@dataclass(frozen=True)
class Line:
    """One thing, whether it is right, and what makes it so."""

    part: Part
    name: str
    state: State
    found: str
    mend: str = ""
    """A command, or a sentence where no command will do; empty if there is nothing to do, or it would not help."""


@dataclass(frozen=True)
class Way:
    """A rasterizer for the GPU, and what it needs besides the GPU itself and torch."""

    name: Literal["Triton", "gsplat"]
    needs: tuple[Line, ...]
    """In the order in which things must be right."""

    @property
    def blocking(self) -> Line | None:
        """The first that is not right; None if all are."""
        return next((line for line in self.needs if line.state != "ok"), None)

    @property
    def effort(self) -> tuple[bool, int]:
        """Less is shorter: whether something cannot be mended at all, and how many things are to be mended."""
        wrong = [line for line in self.needs if line.state != "ok"]
        return any(not line.mend for line in wrong), len(wrong)
