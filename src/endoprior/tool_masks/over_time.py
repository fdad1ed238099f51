"""Tools over a whole clip: what the network says of a place is carried along the optical flow, both ways in time.

Log-odds are averaged over the frames around, weighted by KEEP to the power of the distance in time, where flow leads
back to its start and colors agree. Then a region is a tool if most of the frames around take it for one: a mask that
goes out for a frame, or flares up in one, follows its neighbors. `T` frames, (h, w) the size of the network's image.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ..footage.carry_masks import sampled
from ..footage.image_operations import Image, Mask
from ..footage.optical_flow import MIN_SIZE_PX, flow_pair
from .regions import candidate_regions, joined

KEEP = 0.85  # Weight of the frame before: half a second of video at 25 frames/s
MAX_LOG_ODDS = 6.0  # One sure frame does not outweigh all others
COLOR_SCALE_LEVELS, ROUND_TRIP_SCALE_PX = 15.0, 1.5
"""Differences of color, of 255, and of flow there and back, px, at which a place counts e times less."""
COLOR_BLUR_PX = 1.0
CHUNK, MARGIN = 120, 24  # Frames that are decided at once, and that are known beside them: KEEP^24 is 2 %
AGREED = 0.5  # Share of the frames around that take a region for a tool
MIN_TRUST = 0.2  # Of that: a region that the network outlines in this frame too is hardly another thing
Values = NDArray[np.float32]


@dataclass(frozen=True)
class FramePrediction:
    """What the network predicts of one frame alone."""

    rgb_u8: Image  # (h, w, 3)
    log_odds: Values  # (h, w) of a tool


@dataclass(frozen=True)
class SmallTools:
    """The tools of one frame at the network's size."""

    tool_mask: Mask  # (h, w)
    log_odds: Values  # (h, w) carried over time


def decide_over_time(predictions: Iterable[FramePrediction], view: Mask) -> Iterator[SmallTools]:
    """The tools of each frame of a clip, in order. Args: view: (h, w) True inside the endoscope's image."""
    waiting, first = list[FramePrediction](), 0  # `first` of them are decided and kept as a margin
    for prediction in predictions:
        waiting.append(prediction)
        if len(waiting) == first + CHUNK + MARGIN:
            yield from _decided(waiting, view)[first : first + CHUNK]
            gone = max(first + CHUNK - MARGIN, 0)
            waiting, first = waiting[gone:], first + CHUNK - gone
    if len(waiting) > first:
        yield from _decided(waiting, view)[first:]


def _decided(predictions: list[FramePrediction], view: Mask) -> list[SmallTools]:
    flows = [BidirectionalFlow.between(before, after) for before, after in pairwise(predictions)]
    odds = carried([np.clip(each.log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS) for each in predictions], flows)
    regions = [candidate_regions(each, view) for each in odds]
    taken = [np.any([np.zeros_like(view), *(r.mask for r in found if r.is_tool)], axis=0) for found in regions]
    agreed = carried([mask.astype(np.float32) for mask in taken], flows, MIN_TRUST)
    return [
        SmallTools(joined([r.mask for r in found if share[r.mask].mean() > AGREED], each, view), each)
        for found, share, each in zip(regions, agreed, odds, strict=True)
    ]


@dataclass(frozen=True)
class BidirectionalFlow:
    """Where the pixels of two neighboring frames are in each other, and how far that can be believed."""

    to_before: NDArray[np.float32]  # (h, w, 2) places in the frame before of the pixels of the frame after, px
    to_after: NDArray[np.float32]
    trust_after: Values  # (h, w) 0..1 of the pixels of the frame after
    trust_before: Values

    @classmethod
    def between(cls, before: FramePrediction, after: FramePrediction) -> BidirectionalFlow:
        shape = before.log_odds.shape
        grid = np.dstack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape[::-1])))
        onward = back = np.zeros_like(grid)
        if min(shape) >= MIN_SIZE_PX:
            grays = (cv2.cvtColor(each.rgb_u8, cv2.COLOR_RGB2GRAY) for each in (before, after))
            onward, back = flow_pair(*(np.asarray(gray, np.uint8) for gray in grays))
        colors = [cv2.GaussianBlur(each.rgb_u8.astype(np.float32), (0, 0), COLOR_BLUR_PX) for each in (before, after)]

        def trust(here: NDArray, there: NDArray, flow: NDArray, way_back: NDArray) -> Values:
            color = np.abs(sampled(there, grid + flow) - here).mean(-1) / COLOR_SCALE_LEVELS
            returns = np.linalg.norm(flow + sampled(way_back, grid + flow), axis=-1) / ROUND_TRIP_SCALE_PX
            return np.exp(-(color**2) - returns**2).astype(np.float32)

        ahead, behind = trust(colors[0], colors[1], onward, back), trust(colors[1], colors[0], back, onward)
        return cls(grid + back, grid + onward, behind, ahead)


def carried(values: list[Values], flows: list[BidirectionalFlow], least_trust: float = 0.0) -> list[Values]:
    """(h, w) weighted mean of each frame's values and those of the frames around, carried along the flow."""

    def step(places: NDArray[np.float32], trust: Values) -> tuple[NDArray[np.float32], Values]:
        return places, least_trust + (1 - least_trust) * trust

    ahead = _one_way(values, [step(flow.to_before, flow.trust_after) for flow in flows])
    behind = _one_way(values[::-1], [step(flow.to_after, flow.trust_before) for flow in flows[::-1]])[::-1]
    # Both sums hold the frame itself.
    return [
        ((a[..., 0] + b[..., 0] - own) / (a[..., 1] + b[..., 1] - 1)).astype(np.float32)
        for own, a, b in zip(values, ahead, behind, strict=True)
    ]


def _one_way(values: list[Values], steps: list[tuple[NDArray[np.float32], Values]]) -> list[NDArray[np.float32]]:
    """(h, w, 2) sums of values and of weights, in the order of the list, from places and trust of each step."""
    sums = [np.dstack([own, np.ones_like(own)]) for own in values]
    for i, (places, trust) in enumerate(steps, 1):
        sums[i] += KEEP * trust[..., None] * sampled(sums[i - 1], places)
    return sums
