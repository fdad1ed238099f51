"""One click on a missed tool in one frame finds it in all frames; one on tissue that the masks take for a tool frees
it.

A click on a tool gives examples of the tool, the masks give examples of tissue (`examples`); what they teach is applied
to every frame. Masks only gain pixels. `H, W` image size, `h, w` size of the network's image.

The masked region under the click is carried along the optical flow, from frame to frame and both ways in time. In each
frame, a masked region that lies mostly under it is the same thing and is freed whole; where it merges with a tool, only
the carried part is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.ranges import evenly_spaced
from ..data import FrameSequence
from ..footage.carry_masks import sampled
from ..footage.image_operations import AREA, Mask, components, large_regions, regions_where
from ..footage.optical_flow import MIN_SIZE_PX, flow_pair, gray_for_flow
from .examples import Examples, clicked_region, examples_of, feature_map, fit
from .network import full_size, network_image, small_view
from .over_time import MAX_LOG_ODDS
from .regions import tool_regions
from .tool_finder import ToolFinder, view_of

TAUGHT = 12  # Number of frames, besides the clicked ones, from which examples are taken
MIN_PART_PX = 30
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
    view = view_of(sequence)
    small = small_view(view)

    def features_of(index: int) -> tuple[NDArray[np.float32], Mask]:
        """The features (h, w, k) of a frame, and (h, w) True on its masked tools."""
        rgb_u8, known = sequence.frame(index).rgb_u8, (tool(index) & view).astype(np.float32)
        known = cv2.resize(known, small.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        return feature_map(finder.log_odds(rgb_u8, view), network_image(rgb_u8, view)), known

    taught = sorted({*evenly_spaced(count, TAUGHT), *(click.frame for click in clicks)})
    total, regions, examples = len(taught) + count, dict[int, Mask](), list[Examples]()
    for done, i in enumerate(taught, 1):
        features, known = features_of(i)
        free = small & ~known
        here = [spot for click in clicks if click.frame == i and (spot := _spot(click, free, view.shape))]
        clicked = np.any([np.zeros_like(known), *(clicked_region(features, free, spot) for spot in here)], axis=0)
        if here:
            regions[i] = clicked
        examples.append(examples_of(features, small, known, clicked))
        yield SearchStep(done, total)
    classifier = fit(examples)
    for i in range(count):
        features, known = features_of(i)
        # Known tools count as certain, so that a part which touches one enters the view with it.
        odds = np.clip(classifier.log_odds(features), -MAX_LOG_ODDS, MAX_LOG_ODDS)
        found = np.where(known, MAX_LOG_ODDS, odds).astype(np.float32)
        parts = large_regions(tool_regions(found, small) & ~known, MIN_PART_PX) | regions.get(i, False)
        yield SearchStep(len(taught) + i + 1, total, i, full_size(parts, view.shape) & view & ~tool(i))


def _spot(click: ToolClick, free: Mask, shape: tuple[int, ...]) -> tuple[int, int] | None:
    """(column, row) of the free pixel (h, w) that is nearest to a click in the image (H, W); None if none is free."""
    rows, columns = np.nonzero(free)
    if not len(rows):
        return None
    x, y = click.x * free.shape[1] / shape[1] - 0.5, click.y * free.shape[0] / shape[0] - 0.5
    nearest = int(((columns - x) ** 2 + (rows - y) ** 2).argmin())
    return int(columns[nearest]), int(rows[nearest])


SHARED = 0.5  # Least share of a masked region that lies under the carried one
LEFT = 0.2  # With less of its first area the carried region has left the image


def free_clicked(
    sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask]
) -> Iterator[SearchStep]:
    """Find what to free in every frame, one frame a step, each once for every click.

    Args:
        tool: gives the mask (H, W) of a frame, True on everything that is not tissue.
    Raises:
        InputError: before the first step, for a click in no frame, outside of the image, or not on a mask.
    """
    for click in clicks:
        demand_in_image(click, sequence, tool)
        if not tool(click.frame)[int(click.y), int(click.x)]:
            subject, fix = f"click {click.frame},{click.x:g},{click.y:g}", "Choose a place that is masked."
            raise input_error(subject, "tissue that is masked", "a pixel that is not", fix)
    return _tissue_steps(sequence, clicks, tool)


def _tissue_steps(
    sequence: FrameSequence, clicks: Sequence[ToolClick], tool: Callable[[int], Mask]
) -> Iterator[SearchStep]:
    count, done = len(sequence), 0
    view = view_of(sequence)
    for click in clicks:
        labels, _ = components(tool(click.frame) & view)
        clicked = (labels == labels[int(click.y), int(click.x)]) & (labels > 0)
        done += 1
        yield SearchStep(done, count * len(clicks), click.frame, clicked)
        for order in (range(click.frame, -1, -1), range(click.frame, count)):
            region = clicked
            for before, now in pairwise(order):
                region, freed = _next(sequence, before, now, region, tool(now) & view)
                if region.sum() < LEFT * clicked.sum():
                    region = np.zeros_like(region)
                done += 1
                yield SearchStep(done, count * len(clicks), now, freed)


def _next(sequence: FrameSequence, before: int, now: int, region: Mask, masked: Mask) -> tuple[Mask, Mask]:
    """The region of one frame in the next, and (H, W) what to free there."""
    if not region.any():
        return region, region
    moved = _moved(region, sequence.frame(before).rgb_u8, sequence.frame(now).rgb_u8)
    labels, boxes = components(masked)
    shared = np.bincount(labels[moved], minlength=len(boxes)) / boxes[:, AREA].clip(1)
    same = regions_where(shared > SHARED, labels)
    return (same, same) if same.any() else (moved, moved & masked)


def _moved(region: Mask, before: np.ndarray, now: np.ndarray) -> Mask:
    """(H, W) where the second image (H, W, 3) shows a region of the first."""
    grays = gray_for_flow(before), gray_for_flow(now)
    shape = grays[0].shape
    if min(shape) < MIN_SIZE_PX:
        return region
    back = flow_pair(*grays)[1]
    grid = np.dstack(np.meshgrid(*(np.arange(side, dtype=np.float32) for side in shape[::-1])))
    small = cv2.resize(region.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)
    there = sampled(np.asarray(small, np.float32), grid + back)
    return cv2.resize(there, region.shape[::-1], interpolation=cv2.INTER_LINEAR) > SHARED
