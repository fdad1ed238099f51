"""Detect camera motion. Tissue moves locally and returns; a moving camera shifts, rotates or zooms the whole image.

Static is said only where it was shown: images that nothing links to the others are no evidence of rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import count, repeat
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from .alignment import align, mean_shift
from .image_operations import Image, InOrder, Mask
from .keypoints import track_points

WORK_WIDTH = 320  # Images are resized to this width, px: enough for hundreds of corners, and fast
MAX_CORNERS = 400
MIN_TRACKS = 24  # With fewer tracked corners, no motion is estimated for a pair of images
MIN_INLIERS = 0.4  # Share of corners that must be inliers; below, camera motion does not explain the pair
SHOWN = 0.9  # Share of images that must be linked to one another before the camera counts as static
FEW_CORNERS = 0.3  # Share of the explained steps that only direct alignment explains, above which corners are too few
Kind = Literal["static", "moving", "unknown"]
WORDS: dict[Kind, str] = {
    "static": "the camera is static",
    "moving": "the camera moves",
    "unknown": "the motion of the camera is unknown",
}
MOVING_FRACTION = 0.06
"""The camera moves if the whole image shifts by more than this share of its width. Breathing shifts it by 3 %."""


@dataclass(frozen=True)
class CameraMotion:
    """Motion of the image as a whole, over K images."""

    pixels_per_frame: NDArray[np.float64]
    """(K - 1,) mean shift between successive images, px of the given images; NaN where no motion fits."""
    path_px: NDArray[np.float64]
    """(K,) shift of the whole image from the first image of its stretch, px."""
    stretch: NDArray[np.int64]
    """(K,) first of the images that an image is linked to by explained steps; one that nothing links has itself."""
    limit_px: float  # A larger shift moves the camera
    few_corners: bool  # Whether many of the explained steps need direct alignment

    @property
    def kind(self) -> Kind:
        """Static only if nearly all images are linked and none is far."""
        if self.path_px.max() > self.limit_px:
            return "moving"
        return "static" if np.bincount(self.stretch).max() >= SHOWN * len(self.stretch) else "unknown"

    @property
    def moving(self) -> bool:
        """Whether the camera was seen to move."""
        return self.kind == "moving"

    @property
    def resting(self) -> NDArray[np.bool_]:
        """(K,) True on the most images of one stretch, from its first, that one camera serves."""
        best = np.zeros(len(self.stretch), bool)
        for first in np.unique(self.stretch):
            linked = self.stretch == first
            near = linked & (np.maximum.accumulate(np.where(linked, self.path_px, 0)) <= self.limit_px)
            best = near if near.sum() > best.sum() else best
        return best

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        known, count = np.isfinite(self.pixels_per_frame), np.bincount(self.stretch).max()
        start = "the first frame" if count == len(self.stretch) else f"the first of up to {count} frames in a row"
        usual = np.median(self.pixels_per_frame[known]) if known.any() else 0
        return (
            f"the view moves by up to {self.path_px.max():.0f} px from {start} "
            f"({usual:.1f} px a step; {known.mean() if len(known) else 1.0:.0%} of steps explained)"
        )

    @property
    def text(self) -> str:
        """What is known, and why, in one line."""
        return f"{WORDS[self.kind]}: {self.reason}"


@dataclass(frozen=True)
class _Seen:
    """An image that later ones are compared with."""

    gray: Image
    allowed: Image | None
    first: int  # of its stretch
    chain: NDArray  # (3, 3) transform from that one


def camera_motion(
    images: Iterable[Image], tissue_masks: Iterable[Mask] | None = None, each: InOrder = map
) -> CameraMotion:
    """Chain similarity transforms between successive images: of tracked corners by RANSAC, else of direct alignment.

    An image that nothing links is stepped over. Of the K images (H, W, 3) only a few are in memory at a time.

    Args:
        tissue_masks: (H, W) True on tissue; None allows all.
        each: as `map`; threads can give the results, in order.
    """
    shifts, path, stretch, direct = list[float](), list[float](), list[int](), 0
    before: _Seen | None = None
    anchor: _Seen | None = None
    size, factor = (1, 1), 1.0
    masks = repeat(None) if tissue_masks is None else tissue_masks
    for now, factor, (step, is_direct) in each(_linked, _with_last(each(_seen, zip(count(), images, masks)))):
        index, size = now.first, now.gray.shape[::-1]
        if before is not None:
            direct += is_direct
            shifts.append(np.nan if step is None else mean_shift(step, *size) / factor)
            if step is not None:
                now = replace(now, first=before.first, chain=step @ before.chain)
            elif anchor is not None and anchor is not before and (step := _aligned(anchor, now)) is not None:
                now = replace(now, first=anchor.first, chain=step @ anchor.chain)
        if before is None or now.first != index:  # a single image that nothing links is no anchor
            anchor = now
        path.append(mean_shift(now.chain, *size) / factor)
        stretch.append(now.first)
        before = now
    steps = np.array(shifts)
    few = direct > FEW_CORNERS * max(int(np.isfinite(steps).sum()), 1)
    limit = MOVING_FRACTION * size[0] / factor
    return CameraMotion(steps, np.array(path), np.array(stretch), limit, few)


def _seen(numbered: tuple[int, Image, Mask | None]) -> tuple[_Seen, float]:
    """An image (H, W, 3) of this number as it is compared, and its size as a share of that of the image."""
    index, image, mask = numbered
    factor = min(1.0, WORK_WIDTH / image.shape[1])
    fy = max(factor, 1 / image.shape[0])  # a strip keeps its one row
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    gray = np.asarray(cv2.resize(gray, None, fx=factor, fy=fy, interpolation=cv2.INTER_AREA), np.uint8)
    allowed = None
    if mask is not None:
        allowed = cv2.resize(mask.astype(np.uint8), gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
        allowed = np.asarray(cv2.erode(allowed, np.ones((5, 5))), np.uint8)
    return _Seen(gray, allowed, index, np.eye(3)), factor


def _with_last(images: Iterable[tuple[_Seen, float]]) -> Iterator[tuple[_Seen | None, _Seen, float]]:
    """Each image with the one before."""
    last = None
    for now, factor in images:
        yield last, now, factor
        last = now


def _linked(pair: tuple[_Seen | None, _Seen, float]) -> tuple[_Seen, float, tuple[NDArray | None, bool]]:
    """The transform from the image before, None if there is none; and whether only direct alignment found it."""
    before, now, factor = pair
    if before is None:
        return now, factor, (None, False)
    step = _step(before, now)
    if step is not None:
        return now, factor, (step, False)
    step = _aligned(before, now)
    return now, factor, (step, step is not None)


def _aligned(before: _Seen, now: _Seen) -> NDArray | None:
    return align(before.gray, now.gray, before.allowed, now.allowed)


def _step(before: _Seen, now: _Seen) -> NDArray | None:
    """(3, 3) similarity transform between the corners of two small images; None if too few of them are inliers."""
    found = cv2.goodFeaturesToTrack(before.gray, MAX_CORNERS, 0.01, 5, mask=before.allowed)
    if found is None or len(found) < MIN_TRACKS:
        return None
    corners = np.asarray(found[:, 0], np.float32)
    there, good = track_points(before.gray, now.gray, corners, side_px=15)
    if good.sum() < MIN_TRACKS:
        return None
    cv2.setRNGSeed(0)  # RANSAC uses OpenCV's own random generator
    matrix, inliers = cv2.estimateAffinePartial2D(corners[good], there[good], ransacReprojThreshold=1.5)
    return None if matrix is None or inliers.mean() < MIN_INLIERS else np.vstack([matrix, [0, 0, 1]])
