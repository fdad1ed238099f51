"""The tools that a program found in each frame, and how sure it was: `tool_masks.json` in a sequence folder."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..system.atomic import write_json
from .description import TOOLS_FOUND
from .reading import read_json

FILE = "tool_masks.json"
UNCERTAIN = 0.5  # Masks of a lower confidence should be looked at
WANTED = "a list of frame, share and confidence"
FIX = "remove the file, or find the tools again: `endoprior masks DATA`."


@dataclass(frozen=True)
class FoundTools:
    """The tools of one frame."""

    tool_mask: NDArray[np.bool_]  # (H, W)
    confidence: float
    """0..1: how far the probabilities of all pixels that may be a tool are from one half, on average; 1 if none may."""

    @property
    def uncertain(self) -> bool:
        """Whether the mask should be looked at."""
        return self.confidence < UNCERTAIN


@dataclass(frozen=True)
class FrameRow:
    """What `FILE` holds of one frame."""

    frame: int  # its place in the whole sequence, from 0
    share: float  # of the image that is tool, 0..1
    confidence: float  # as in `FoundTools`
    moves_unmasked: bool = False
    """Whether something enters the view and moves that the mask does not cover; stored only where it is True."""

    @classmethod
    def of(cls, frame: int, found: FoundTools) -> FrameRow:
        """The row of a frame in which `found` was found."""
        return cls(frame, float(found.tool_mask.mean()), float(found.confidence))

    @classmethod
    def read(cls, file: Path, value: Any) -> FrameRow:
        """The row that a JSON value of the file stands for."""
        try:
            row = cls(**value)
            usable = type(row.frame) is int and row.frame >= 0 and 0 <= row.share <= 1 and 0 <= row.confidence <= 1
            usable = usable and isinstance(row.moves_unmasked, bool)
        except TypeError:
            usable = False
        if not usable:
            raise input_error(file, WANTED, f"{value!r:.80}", FIX)
        return row

    def stored(self) -> dict[str, Any]:
        """The JSON value."""
        return {name: value for name, value in asdict(self).items() if name != "moves_unmasked" or value}

    def with_added(self, share: float) -> FrameRow:
        """The row when a share of the image is added to the mask, or removed from it, -1..1."""
        share_now = min(max(self.share + share, 0.0), 1.0)
        return replace(self, share=share_now, moves_unmasked=self.moves_unmasked and not share)


def write_rows(folder: Path, rows: Iterable[FrameRow]) -> None:
    """Write the rows of a sequence folder."""
    write_json(folder / FILE, [row.stored() for row in rows])


def read_rows(folder: Path) -> list[FrameRow]:
    """The rows of a sequence folder; none if no program found its tools."""
    file = folder / FILE
    return [FrameRow.read(file, value) for value in read_json(file, FIX, WANTED, list)] if file.is_file() else []


def drop_rows(folder: Path, frames: Iterable[int]) -> None:
    """Remove the rows of frames whose masks a person has corrected: they are not in doubt any more."""
    corrected = set(frames)
    if rows := read_rows(folder):
        write_rows(folder, [row for row in rows if row.frame not in corrected])


def mark_moving(folder: Path, frames: Iterable[int]) -> None:
    """Note the frames in which something moves that no mask covers."""
    moving = set(frames)
    if moving and (rows := read_rows(folder)):
        write_rows(folder, [replace(row, moves_unmasked=row.frame in moving) for row in rows])


def uncertain_frames(rows: Iterable[FrameRow]) -> list[int]:
    """The frames whose masks should be looked at."""
    return [row.frame for row in rows if row.confidence < UNCERTAIN]


def found_source(with_tools: float, followed_by: str = "") -> str:
    """The source of masks that a program found in a share of the frames, 0..1, and another followed, if any."""
    found = f"{TOOLS_FOUND} in {with_tools:.0%} of the frames" if with_tools else f"no {TOOLS_FOUND}"
    return f"{found}, followed by {followed_by}" if followed_by else found
