"""One click on a missed tool in one frame finds it in all frames.

The click gives examples of the tool, the masks give examples of tissue (`examples`); what they teach is applied to
every frame. Masks only gain pixels. `H, W` image size, `h, w` size of the network's image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.ranges import evenly_spaced
from ..data import FrameSequence
from ..footage.components import Mask, large_regions
from .examples import Examples, clicked_region, examples_of, feature_map, fit
from .network import ToolFinder, full_size, network_image, small_view
from .over_time import MOST_LOG_ODDS
from .regions import tool_regions
from .sequence import SAMPLES, view_of

TAUGHT = 12  # Number of frames, besides the clicked ones, from which examples are taken
LEAST_PART_PX = 30
"""Smaller parts are left out: pieces of the rims of known tools, which would change the masks of all frames."""


@dataclass(frozen=True)
class ToolClick:
    """A click on a tool that the masks miss, or on tissue that they take for one."""

    frame: int  # Its place in the sequence, from 0
    x: float  # px of the image, 0 at its left edge
    y: float  # px of the image, 0 at its upper edge


def parse_click(text: str, option: str) -> ToolClick:
    """A click from `FRAME,X,Y`; InputError for a text of another form."""
    try:
        frame, x, y = text.split(",")
        return ToolClick(int(frame), float(x), float(y))
    except ValueError:
        raise input_error(option, "FRAME,X,Y", repr(text), f"`{option} 12,310,205`.") from None


@dataclass(frozen=True)
class SearchStep:
    """What is known after each frame of a search."""

    done: int
    total: int  # Frames of both passes: those that teach, and all
    frame: int | None = None  # The frame that was searched; None while examples are gathered
    region: Mask | None = None  # (H, W) True on what its mask is to gain, or to lose


def find_clicked(
    sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask], finder: ToolFinder | None = None
) -> Iterator[SearchStep]:
    """Find the clicked tools in every frame, one frame a step. `tool` gives the mask (H, W) of a frame, True on
    everything that is not tissue. InputError before the first step for a click in no frame, outside of the image, or on
    a mask.
    """
    check_clicks(sequence, clicks, tool)
    return _steps(sequence, clicks, tool, finder or ToolFinder())


def check_clicks(sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask]) -> None:
    """Raise the errors of `find_clicked`."""
    for click in clicks:
        demand_in_image(click, sequence, tool)
        if tool(click.frame)[int(click.y), int(click.x)]:
            subject, fix = f"click {click.frame},{click.x:g},{click.y:g}", "Choose a place that is not masked."
            raise input_error(subject, "a tool that is not masked", "a masked pixel", fix)


def demand_in_image(click: ToolClick, sequence: FrameSequence, tool: Callable[[int], Mask]) -> None:
    """Raise InputError unless a click is in a frame of the sequence, and inside of its image."""
    subject = f"click {click.frame},{click.x:g},{click.y:g}"
    if not 0 <= click.frame < len(sequence):
        fix = "Name a frame of the sequence."
        raise input_error(subject, f"a frame of 0..{len(sequence) - 1}", str(click.frame), fix)
    height, width = tool(click.frame).shape
    if not (0 <= click.x < width and 0 <= click.y < height):
        got = f"{click.x:g},{click.y:g}"
        raise input_error(subject, f"a place in {width}x{height} px", got, "Choose a place in the image.")


def _steps(
    sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask], finder: ToolFinder
) -> Iterator[SearchStep]:
    count = len(sequence)
    view = view_of([sequence.frame(i) for i in evenly_spaced(count, SAMPLES)])
    small = small_view(view)

    def look(index: int) -> tuple[NDArray[np.float32], Mask]:
        """The features (h, w, k) of a frame, and (h, w) True on its masked tools."""
        rgb_u8, known = sequence.frame(index).rgb_u8, (tool(index) & view).astype(np.float32)
        known = cv2.resize(known, small.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        return feature_map(finder.log_odds(rgb_u8, view), network_image(rgb_u8, view)), known

    taught = sorted({*evenly_spaced(count, TAUGHT), *(click.frame for click in clicks)})
    total, regions, examples = len(taught) + count, dict[int, Mask](), list[Examples]()
    for done, i in enumerate(taught, 1):
        features, known = look(i)
        free = small & ~known
        here = [spot for click in clicks if click.frame == i and (spot := _spot(click, free, view.shape))]
        clicked = np.any([np.zeros_like(known), *(clicked_region(features, free, spot) for spot in here)], axis=0)
        if here:
            regions[i] = clicked
        examples.append(examples_of(features, small, known, clicked))
        yield SearchStep(done, total)
    classifier = fit(examples)
    for i in range(count):
        features, known = look(i)
        # Known tools count as certain, so that a part which touches one enters the view with it.
        odds = np.clip(classifier.log_odds(features), -MOST_LOG_ODDS, MOST_LOG_ODDS)
        found = np.where(known, MOST_LOG_ODDS, odds).astype(np.float32)
        parts = large_regions(tool_regions(found, small) & ~known, LEAST_PART_PX) | regions.get(i, False)
        yield SearchStep(len(taught) + i + 1, total, i, full_size(parts, view.shape) & view & ~tool(i))


def _spot(click: ToolClick, free: Mask, shape: tuple[int, ...]) -> tuple[int, int] | None:
    """(column, row) of the free pixel (h, w) that is nearest to a click in the image (H, W); None if none is free."""
    rows, columns = np.nonzero(free)
    if not len(rows):
        return None
    x, y = click.x * free.shape[1] / shape[1] - 0.5, click.y * free.shape[0] / shape[0] - 0.5
    nearest = int(((columns - x) ** 2 + (rows - y) ** 2).argmin())
    return int(columns[nearest]), int(rows[nearest])
