"""Score a tool finder on sets of frames: what is missed inside of tools, what is taken beside them.

Outlines by hand and found ones differ by a few pixels, so neither counts: `core` is the true mask without its rim, and
only what lies outside of the widened true mask is false. `H, W` image size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import astuple, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from endoprior.core.ranges import evenly_spaced
from endoprior.tool_masks import ToolFinder
from endoprior.tool_masks.regions import disk

RIM_PX = 6
"""Width of the rim that does not count, px of an image whose longer side is 640 px."""
FALSE_TOOL = 0.002
"""Share of the view from which on a mask in a frame without a tool counts as a false tool."""
SHOWN = 3


@dataclass(frozen=True)
class TestFrame:
    """One frame with its truth."""

    name: str
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3), 0..255."""
    view: NDArray[np.bool_]
    """(H, W) True inside the endoscope's image."""
    tools: NDArray[np.bool_]
    """(H, W) True on tools."""
    counted: NDArray[np.bool_]
    """(H, W) True where the truth is known."""


@dataclass(frozen=True)
class Counts:
    """Numbers of pixels, and of frames, of one frame or many."""

    hit: int = 0
    either: int = 0
    core: int = 0
    core_missed: int = 0
    beside: int = 0
    """Outside of the widened tools."""
    false: int = 0
    """Found there."""
    tool_free_frames: int = 0
    false_tools: int = 0
    """Tool-free frames with a mask."""

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def scores(self) -> dict[str, float]:
        """IoU, missed core, false area, share of tool-free frames with a false tool; NaN where there is none."""
        return {
            "iou": _ratio(self.hit, self.either if self.core else 0),
            "missed_core": _ratio(self.core_missed, self.core),
            "false_area": _ratio(self.false, self.beside),
            "false_frames": _ratio(self.false_tools, self.tool_free_frames),
        }


@dataclass(frozen=True)
class SetScore:
    """The result of one set."""

    total: Counts
    shown: tuple[tuple[TestFrame, NDArray[np.bool_]], ...]
    """The best, a middle and the worst frame with what was found, by false and missed pixels."""


def score_set(finder: ToolFinder, frames: Iterable[TestFrame]) -> SetScore:
    """Find the tools of each frame, and compare."""
    total, seen = Counts(), []
    for frame in frames:
        found = finder.find(frame.rgb_u8, frame.view).tool_mask
        counts = count(found, frame)
        total += counts
        seen.append((counts.core_missed + counts.false, frame, found))
    order = sorted(range(len(seen)), key=lambda k: seen[k][0])
    return SetScore(total, tuple(seen[order[k]][1:] for k in evenly_spaced(len(order), SHOWN)))


def count(found: NDArray[np.bool_], frame: TestFrame) -> Counts:
    """Compare the mask (H, W) of one frame with its truth."""
    counted = frame.counted & frame.view
    tools, found = frame.tools & counted, found & counted
    rim = disk(max(1, round(RIM_PX * max(tools.shape) / 640)))
    core = cv2.erode(tools.astype(np.uint8), rim, borderType=cv2.BORDER_REPLICATE) > 0
    beside = counted & ~(cv2.dilate(tools.astype(np.uint8), rim) > 0)
    free = not tools.any()
    return Counts(
        hit=int((found & tools).sum()),
        either=int((found | tools).sum()),
        core=int(core.sum()),
        core_missed=int((core & ~found).sum()),
        beside=int(beside.sum()),
        false=int((beside & found).sum()),
        tool_free_frames=int(free),
        false_tools=int(free and found.sum() > FALSE_TOOL * counted.sum()),
    )


def pictures(score: SetScore) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Name and picture (H, W, 3) of the shown frames: green is found rightly, red is missed, blue is false."""
    for frame, found in score.shown:
        image = frame.rgb_u8.astype(np.float32)
        for part, color in (
            (found & frame.tools, (0, 255, 0)),
            (frame.tools & frame.counted & ~found, (255, 0, 0)),
            (found & ~frame.tools & frame.counted, (0, 80, 255)),
        ):
            image[part] = 0.55 * image[part] + 0.45 * np.array(color, np.float32)
        yield frame.name, image.astype(np.uint8)


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
