"""Carry the correction of one frame's mask along the optical flow to the frames around it.

A correction is two regions: pixels that were added to the mask, and pixels that were removed. Both move with the image.
The position in the corrected frame of every pixel is composed step by step, so the regions are resampled only once and
do not blur from frame to frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .image_operations import Image, Mask
from .optical_flow import MIN_SIZE_PX, flow_pair, flow_shrink, gray_for_flow

CARRY_ROUND_TRIP_PX, CARRY_ROUND_TRIP_SHARE = 1.5, 0.1
"""A pixel returns if forward and backward flow disagree by at most this, px of the flow, plus this share of the step.
DIS is exact to a fraction of a pixel where it follows the image, and wrong by several pixels where it does not."""
MIN_RETURNING = 0.5
"""Carrying stops where a smaller share of the region returns: the outline is uncertain, and the next step would start
from it. At the rim of a tool, tissue appears and disappears; this never returns and is up to half of a thin region."""
MAX_COLOR_CHANGE = 20.0
"""Carrying stops where the median color of the region's pixels is this far from the corrected frame, in levels of 255:
something else is there. Noise and video coding change it by less than 5, highlights only a part of the pixels."""
MIN_AREA = 0.5
"""Carrying stops where less than this share of the region is left: it leaves the image, or its motion was wrong."""
AGREES = 0.95  # A mask that has this share of the correction already is left: its outline is better than a carried one
SMOOTH_PX = 16.0
"""Standard deviation of the average of the motion of a region, px of the flow: twice the patches of DIS. With less, the
motion of the tissue leaks into tools without texture, and the region shrinks within 30 frames."""
BLUR_PX = 1.0  # Standard deviation of the blur before colors are compared, px of the flow

Positions = NDArray[np.float32]
"""(H, W, 2) for each pixel of a frame, where it is in another one: x, y in px, (0, 0) at the center of the first pixel;
NaN where it is outside of that frame."""
ReadImage = Callable[[int], Image]
ReadMask = Callable[[int], Mask]


@dataclass(frozen=True)
class CarriedEdit:
    """The masks that change, and why carrying stopped."""

    masks: dict[int, Mask]  # (H, W) new mask of each changed frame, without the corrected frame itself
    before: str  # Why it stopped on the way to the first frame, such as `frame 3: the color changed`
    after: str  # Why it stopped on the way to the last frame


def carry_mask_edit(
    frame_at: ReadImage, mask_at: ReadMask, num_frames: int, frame_index: int, edited_mask: Mask
) -> CarriedEdit:
    """Apply the correction of one mask to the frames before and after it, until the flow is no longer reliable.

    `frame_at` reads a frame (H, W, 3), one at a time, in the order of carrying; `mask_at` its mask (H, W) before the
    correction. ValueError for unequal shapes, or frames smaller than `MIN_SIZE_PX`.
    """
    if not 0 <= frame_index < num_frames:
        raise IndexError(f"frame_index must be in 0..{num_frames - 1}; got {frame_index}")
    start, before = frame_at(frame_index), mask_at(frame_index)
    check_shape("frame:H,W,3 mask:H,W edited:H,W", frame=start, mask=before, edited=edited_mask)
    if min(before.shape) < MIN_SIZE_PX:
        raise ValueError(f"frames must be at least {MIN_SIZE_PX} px wide and high; got {before.shape[::-1]}")
    added, removed = edited_mask & ~before, before & ~edited_mask
    changed: dict[int, Mask] = {}
    to_first = _carry(frame_at, mask_at, range(frame_index, -1, -1), added, removed, changed)
    to_last = _carry(frame_at, mask_at, range(frame_index, num_frames), added, removed, changed)
    return CarriedEdit(dict(sorted(changed.items())), to_first, to_last)


def _carry(
    frame_at: ReadImage, mask_at: ReadMask, order: range, added: Mask, removed: Mask, changed: dict[int, Mask]
) -> str:
    """Carry through the frames of `order`, which starts with the corrected one. Returns why it stopped."""
    corrected = region = added | removed
    size = int(region.sum())
    if not size:
        return "nothing was corrected"
    start, start_color = _small(frame_at(order[0]))
    gray, positions = start, _grid(*start.shape)
    for number in order[1:]:
        before = gray
        gray, color = _small(frame_at(number))
        share, near = _follow(before, gray, region)
        if share < MIN_RETURNING:
            return f"frame {number}: the motion is uncertain; {share:.0%} of the region returns along the flow"
        positions = sampled(positions, near)
        # Small errors of each step add up. Compare with the corrected frame itself, where that is possible.
        expected = np.where(_unknown(positions), gray, sampled(start, positions))
        share, near = _follow(expected, gray, _moved(corrected, positions))
        if share >= MIN_RETURNING:
            positions = sampled(positions, near)
        painted, erased = (_moved(part, positions) for part in (added, removed))
        region = painted | erased
        if region.sum() < MIN_AREA * size:
            return f"frame {number}: {region.sum() / size:.0%} of the region is left in the image"
        inside = _at_size(region, gray) > 0
        difference = cv2.absdiff(color, sampled(start_color, positions))[inside].mean(-1)
        if (change := float(np.median(difference))) > MAX_COLOR_CHANGE:
            return f"frame {number}: the color of the region changed by {change:.0f} of 255 levels"
        mask = mask_at(number)
        agrees = (painted & mask) | (erased & ~mask)
        if agrees.sum() < AGREES * region.sum():
            changed[number] = (mask | painted) & ~erased
    return "the first frame" if order.step < 0 else "the last frame"


def _small(frame: Image) -> tuple[Image, Image]:
    """(h, w) gray and (h, w, 3) blurred color of a frame at the size of the flow."""
    gray = gray_for_flow(frame)
    color = cv2.resize(frame, gray.shape[::-1], interpolation=cv2.INTER_AREA)
    return gray, np.asarray(cv2.GaussianBlur(color, (0, 0), BLUR_PX), np.uint8)


def _follow(first: Image, second: Image, region: Mask) -> tuple[float, Positions]:
    """The share of a region (H, W) of the first gray image that returns, and where pixels of the second come from."""
    onward, back = flow_pair(first, second)
    small, grid = _at_size(region, first), _grid(*first.shape)
    error, step = (np.hypot(each[..., 0], each[..., 1]) for each in (onward + sampled(back, grid + onward), onward))
    returns = error <= CARRY_ROUND_TRIP_PX + CARRY_ROUND_TRIP_SHARE * step
    share = float(np.average(returns, weights=small)) if small.any() else 0.0
    return share, _origins(small, onward, returns) if share else grid


def _origins(region: NDArray[np.float32], onward: NDArray[np.float32], returns: Mask) -> Positions:
    """(h, w, 2) where the pixels of the next frame come from, if they move like the region; NaN far from it. Near an
    outline the flow mixes both sides, so the motion is taken from the inside of the region, where the flow onward
    returns, and continued beyond its outline.
    """
    inside = cv2.distanceTransform((region > 0).astype(np.uint8), cv2.DIST_L2, 5)
    weights = (region * returns * inside**2)[..., None]
    total, weighted = _smooth(weights), _smooth(weights * onward)
    motion = weighted / np.where(total > 0, total, np.nan)[..., None]
    grid, mean = _grid(*region.shape), (weights * onward).sum((0, 1)) / weights.sum()
    near = grid - mean
    for _ in range(3):  # the position at which the motion leads to the pixel; the motion is smooth, so this converges
        near = grid - sampled(motion, near)
    return near


def _at_size(region: Mask, image: NDArray) -> NDArray[np.float32]:
    """(h, w) share of each pixel of an image in a region (H, W)."""
    share = cv2.resize(region.astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(share, np.float32)


def _moved(region: Mask, positions: Positions) -> Mask:
    """A region (H, W) of the corrected frame in the frame of these `positions` (h, w, 2), which may be smaller."""
    shrink = flow_shrink(*region.shape)
    away = cv2.resize(positions - _grid(*positions.shape[:2]), region.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return sampled(region, _grid(*region.shape) + shrink * away)


def _smooth(values: NDArray) -> NDArray:
    """A Gaussian average over `SMOOTH_PX`, computed at a quarter of the size, which makes it fast."""
    height, width = values.shape[:2]
    small = cv2.resize(values, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), SMOOTH_PX / 4), (width, height), interpolation=cv2.INTER_LINEAR)


def sampled(values: NDArray, positions: Positions) -> NDArray:
    """The values (H, W) or (H, W, C) of an image at positions in it, bilinear; of a mask, where more than half is True.

    Outside of the image the nearest pixel counts: a tool that reaches the border continues beyond it. Where the
    position is NaN, a mask is False, an image is 0 and numbers are NaN.
    """
    unknown = _unknown(positions)
    x, y = (np.where(unknown, np.float32(0), positions[..., k]) for k in (0, 1))
    is_mask = values.dtype == np.bool_
    stored = values.astype(np.float32) if is_mask else values
    found = cv2.remap(stored, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found[unknown] = np.nan if values.dtype.kind == "f" else 0
    return found > 0.5 if is_mask else found


def _unknown(positions: Positions) -> Mask:
    return np.isnan(positions[..., 0] + positions[..., 1])


def _grid(height: int, width: int) -> Positions:
    return np.dstack(np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)))
