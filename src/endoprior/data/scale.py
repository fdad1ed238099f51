"""The scale of a sequence with one eye: mm per unit of its relative depth, known from something in the images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.checks import input_error
from .description import SCALED

MIN_FACTOR, MAX_FACTOR = 0.02, 50.0
"""Range of factors: relative depth has a median of 70, tissue is 1.4 mm to 3.5 m away."""
GIVE_BOTH = "correct them, or remove all three."


@dataclass(frozen=True)
class Scale:
    """Lengths in mm = `factor` x lengths in relative units."""

    factor: float  # > 0
    error: float  # standard deviation of log(factor): 0.07 is 7 %
    source: str  # such as `known length in frame 12`

    @property
    def text(self) -> str:
        """In one line, for a person."""
        return f"{self.source}; lengths in mm err by {self.error:.0%} (standard deviation of the scale)"

    @property
    def described(self) -> dict[str, Any]:
        """Its entries of `sequence.json`."""
        return {"scale_factor": self.factor, "scale_error": self.error, "scale_source": self.source}


def demand_plausible(option: str, factor: float) -> None:
    """Raise InputError if tissue would be at no distance of an endoscope; `option` gave the factor."""
    if not MIN_FACTOR <= factor <= MAX_FACTOR:
        want = f"a scale of {MIN_FACTOR:g} to {MAX_FACTOR:g} mm per unit of relative depth"
        raise input_error(option, want, f"{factor:.3g}", "correct the frame, the points or the length in mm.")


def described_scale(path: Path, described: dict[str, Any]) -> Scale | None:
    """The scale in the checked contents of a `sequence.json`; None if there is none.

    Raises:
        InputError: only a part of it is there, or depth is relative all the same.
    """
    there = [key for key in SCALED if key in described]
    if not there:
        return None
    if len(there) < len(SCALED):
        raise input_error(path, f"all of {', '.join(SCALED)}", f"only {', '.join(there)}", GIVE_BOTH)
    if described.get("depth_relative", False):
        raise input_error(path, "depth_relative false with scale_factor", "true", GIVE_BOTH)
    return Scale(float(described["scale_factor"]), float(described["scale_error"]), described["scale_source"])


def without_scale(described: dict[str, Any]) -> dict[str, Any]:
    """The description of a sequence whose scale is not known any more; its numbers stay as they are."""
    return {key: value for key, value in described.items() if key not in SCALED} | {"depth_relative": True}


def demand_relative(folder: Path, described: dict[str, Any]) -> None:
    """Raise InputError unless the depth of a folder is relative, or was before it got a scale."""
    if not described.get("depth_relative", False) and described_scale(folder, described) is None:
        fix = "leave the folder as it is: its lengths are in mm already."
        raise input_error(folder, "relative depth, of a video with one eye", "depth in mm", fix)
