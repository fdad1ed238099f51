"""What is looked at, as one frozen value, and the rules of the clock: which frame is due, how sharp to draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Layer = Literal["color", "depth", "alpha", "motion", "prior", "frame", "difference"]
"""`color`, `depth` and `alpha` as rendered; `motion` since the first frame; `prior` the texture-prior score; `frame`
the original; `difference` rendered minus original."""

SLOW_MS = 60.0
"""A picture that takes longer than this to draw at full size is drawn at half size while something moves."""
REST_SECONDS = 0.25
"""Still for that long, the picture is drawn again at full size."""


@dataclass(frozen=True)
class Look:
    """Everything the panel chooses. The viewports of the browsers are not part of it."""

    frame: int = 0
    """0-based frame of the sequence."""
    layer: Layer = "color"
    endoscope: bool = True
    """Seen from the sequence's own camera of that frame; False: from where the browser's camera is."""
    in_browser: bool = False
    """Gaussians are sent to the browser, which draws them smoothly; False: our renderer draws, exactly."""
    points: bool = False
    """Small opaque dots in place of splats."""
    tool: bool = False
    """The tool as filmed is laid over the picture, with an outline."""
    near: float = 0.0
    """Nothing nearer than this depth is drawn, mm."""
    far: float = float("inf")
    """Nothing farther than this depth is drawn, mm."""
    tracks: bool = False
    """Material points are shown with where they were in the frames before."""


def frame_due(start: int, seconds: float, frames_per_second: float, total: int) -> int:
    """The frame to show `seconds` after the frame `start` was; the film repeats."""
    return (start + int(seconds * frames_per_second)) % total


def shrink_factor(still_seconds: float, full_ms: float) -> int:
    """Divisor of the picture's size: 2 while something moves and a full picture takes too long, else 1.

    Args:
        still_seconds: time since something moved.
        full_ms: what the last picture of full size took to draw.
    """
    return 2 if still_seconds < REST_SECONDS and full_ms > SLOW_MS else 1
