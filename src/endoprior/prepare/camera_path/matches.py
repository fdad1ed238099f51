"""Corners of a frame, found again in frames that see them from another side, with no frame between them.

A partner is warped into the frame by depth and the path so far. What is left is an optical flow of few pixels (Lucas
and Kanade 1981), which does not drift as a track from frame to frame does. `N` corners.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...footage.optical_flow import follow_and_return
from ...system.memory import BoundedCache, cache_bytes
from ...system.parallel import frame_threads
from .even_view import EvenView, Warp
from .partners import choose_partners
from .tracks import PoseInput

CORNERS, MIN_IN_FRAME, MAX_IN_FRAME = 6000, 30, 150  # of all frames; at least and at most of one
QUALITY, APART = 0.01, 1 / 60  # of a corner, to the best one; distance to the next, as a share of the width
INNER_PX = 4  # corners and matches keep so far from what is not usable
WINDOW_PX, LEVELS = 21, 1  # of the optical flow
STOP = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005
MAX_BACK_PX, MAX_SHIFT_PX = 0.5, 8.0  # a match leads back to its corner, and is near where the path expects it
CONTRAST = 2.5  # standard deviations of the detail that the flow tells apart
BYTES_PER_PX = 100  # memory in which a thread matches a frame


@dataclass(frozen=True)
class Matches:
    """Where other frames see the corners of one frame."""

    pixels: NDArray[np.float32]  # (N, 2) in the frame, px; the left-most pixel is centered at 0
    depth: NDArray[np.float32]  # (N,) that was assumed, in the unit of the path
    partners: tuple[int, ...]
    seen: NDArray[np.float32]  # (len(partners), N, 2) px; NaN where a partner does not see the corner


@dataclass(frozen=True)
class _Picture:
    """A frame as the flow reads it."""

    detail_u8: NDArray[np.uint8]  # (h, w)
    inner: NDArray[np.uint8]  # (h, w) 255 well inside of what is usable, else 0
    depth: NDArray[np.float32]  # (h, w)


def match_frames(
    frame: Callable[[int], PoseInput],
    world_to_camera: NDArray[np.float64],
    usable: NDArray[np.bool_],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
) -> Iterator[Matches | None]:
    """The matches of each frame, in order; None for a frame without partners.

    Args:
        frame: reads frame i, with its depth in the unit of the path.
        world_to_camera: (T, 4, 4). usable: (T,) whether a frame has a pose of its own.
        matrix: (3, 3) K at `size`, px; the left-most pixel is centered at 0. size: (w, h) at which to match, px.
    """
    pictures: BoundedCache[_Picture] = BoundedCache(cache_bytes(), lambda each: 6 * each.depth.size)
    everything, count = range(len(usable)), int(np.clip(CORNERS / max(len(usable), 1), MIN_IN_FRAME, MAX_IN_FRAME))

    def picture(i: int) -> _Picture:
        return pictures.get(i, lambda: _picture(frame(i), size))

    def distance(i: int) -> float:
        depth = picture(i).depth
        return float(np.median(depth[depth > 0])) if (depth > 0).any() else np.nan

    with frame_threads(BYTES_PER_PX * size[0] * size[1]) as pool:
        distances = np.array(list(pool.map(distance, everything)))
        usable = usable & np.isfinite(distances)
        partners = choose_partners(world_to_camera, matrix, size, np.where(usable, distances, 1.0), usable)

        def matched(i: int) -> Matches | None:
            others = partners[i]
            warps = [Warp.between(matrix, world_to_camera[i], world_to_camera[j], size) for j in others]
            return _matched(picture(i), others, [picture(j) for j in others], warps, count) if others else None

        yield from pool.map(matched, everything)


def _picture(seen: PoseInput, size: tuple[int, int]) -> _Picture:
    view = EvenView.of(seen.rgb_u8, seen.tissue_mask, size)
    std = float(view.detail[view.usable > 0].std()) if view.usable.any() else 1.0
    levels = np.clip(128 + 128 / (CONTRAST * max(std, 1e-6)) * view.detail, 0, 255).astype(np.uint8)
    depth = cv2.resize(seen.depth, size, interpolation=cv2.INTER_NEAREST)
    inner = cv2.erode((view.usable * (depth > 0)).astype(np.uint8) * 255, np.ones((2 * INNER_PX + 1,) * 2, np.uint8))
    return _Picture(levels, np.asarray(inner, np.uint8), np.asarray(depth, np.float32))


def _matched(
    here: _Picture, others: tuple[int, ...], there: Sequence[_Picture], warps: Sequence[Warp], count: int
) -> Matches:
    width = here.depth.shape[1]
    corners = cv2.goodFeaturesToTrack(here.detail_u8, count, QUALITY, max(APART * width, 4), mask=here.inner)
    pixels = np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners, np.float32).reshape(-1, 2)
    at = np.round(pixels).astype(int)
    inverse = np.where(here.depth > 0, 1 / np.maximum(here.depth, 1e-6), 0).astype(np.float32)
    seen = np.full((len(others), len(pixels), 2), np.nan, np.float32)
    for found, other, warp in zip(seen, there, warps, strict=True):
        if len(pixels):
            found[:] = _found(here.detail_u8, other, warp, inverse, pixels)
    return Matches(pixels, here.depth[at[:, 1], at[:, 0]], others, seen)


def _found(
    detail_u8: NDArray[np.uint8], other: _Picture, warp: Warp, inverse: NDArray[np.float32], pixels: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(N, 2) px of the corners (N, 2) in another frame, NaN where they are not found."""
    x, y, _ = (each.astype(np.float32) for each in warp.at(inverse))
    warped = np.asarray(cv2.remap(other.detail_u8, x, y, cv2.INTER_LINEAR, borderValue=128), np.uint8)
    now, back, good = follow_and_return(detail_u8, warped, pixels, side_px=WINDOW_PX, halvings=LEVELS, criteria=STOP)
    good &= (np.hypot(*(back - pixels).T) < MAX_BACK_PX) & (np.hypot(*(now - pixels).T) < MAX_SHIFT_PX)
    place = np.stack([cv2.remap(each, now[:, :1], now[:, 1:], cv2.INTER_LINEAR).ravel() for each in (x, y)], 1)
    inner = cv2.remap(other.inner, place[:, :1], place[:, 1:], cv2.INTER_NEAREST, borderValue=0).ravel() > 0
    return np.where((good & inner)[:, None], place, np.nan).astype(np.float32)
