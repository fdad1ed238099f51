"""When a sequence is cut into windows that have Gaussians of their own: the part of the config. See `config.py`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from .checks import check_range
from .ranges import Checked, Positive, Range, Share, Weight


@dataclass(frozen=True)
class WindowConfig(Checked):
    """Where a long sequence is cut. A moving camera sees other tissue after a while; memory should not grow."""

    enabled: bool = False
    """Cut where one of the rules below says so; else the whole sequence is one window."""
    turn_degrees: Annotated[float, Range(0, 180)] = 15.0
    """A window ends where the camera has turned by this since the window's first frame, degrees, ..."""
    shift_share: Weight = 0.1
    """... or has moved by this share of the median depth ..."""
    picture_change: Share = 0.05
    """... or, where the camera moves at all, the picture differs by this: mean absolute difference of color."""
    shortest: Positive = 40
    """These rules count from this frame of a window on."""
    longest: Positive = 200
    """A window ends here at the latest."""
    overlap: Annotated[int, Range(0, 10_000)] = 20
    """Frames that a window shares with the next one: in the middle half of them one fades into the other."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("windows.longest", self.longest, self.shortest, 10_000_000)
        check_range("windows.overlap", self.overlap, 0, self.shortest // 2)
