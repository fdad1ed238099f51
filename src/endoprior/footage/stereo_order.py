"""Stereo pairs: dense matching, which image is the left one, are the rows aligned, what does the right eye see?

The matcher is OpenCV's semi-global matching (H. Hirschmüller, "Stereo processing by semiglobal matching and mutual
information", PAMI 2008, with Birchfield and Tomasi's cost over blocks), along all eight directions.

A point at column x of the left image is at column x - disparity of the right one; disparity is fx baseline / z, px,
(H, W), and 0 where no depth was measured. `H, W` image size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from ..core.geometry import bilinear, pixel_centers, right_camera
from ..core.types import Frame
from .image_operations import Image, Mask
from .keypoints import keypoints, match_descriptors

SMALL_STEP, LARGE_STEP = 16, 64
"""Penalty per block pixel for a disparity change of one px between neighbors, and for a larger change."""
UNIQUENESS_PERCENT = 10  # Margin by which the best match must beat the second best
CONTRAST_LIMIT = 31  # Image gradients are clipped to this before matching, levels
LOOK_WIDTH = 320  # The order of the images is found at this width, px
NEAREST_SHARE = 0.2
"""Largest disparity of that search, as a share of the width: about that of a point 20 mm away at a 4 mm baseline."""
BLOCK_PX = 7  # Side of its matching blocks, px
AGREE_PX = 1.0  # Tolerance of its left-right consistency check, px
CLEARLY = 0.2  # The pair counts as swapped if the swapped order matches this much more of the image
FEATURES = 1000  # Largest number of features per image
RATIO = 0.75  # A feature's best match must be nearer than this times its second best (D. Lowe, IJCV 2004)
MIN_MATCHES = 20  # With fewer matches the vertical offset is unknown


def match_both_ways(
    left: Image, right: Image, lowest: int, highest: int, block: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Disparity x_left - x_right, px in steps of 1/16, at the pixels of both gray images (H, W); NaN where no match is
    unique. A match outside the other image is extrapolated from neighbors. Disparities may be negative; the matching
    block has an odd side.
    """
    # After mirroring both images, the right image is matched like a left one.
    mirrored = _match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), lowest, highest, block)
    return _match(left, right, lowest, highest, block), np.ascontiguousarray(mirrored[:, ::-1])


def disagreement(from_left: NDArray[np.float32], from_right: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) left-right consistency: difference of the two disparities at matching pixels, px; infinite where either is
    unknown, and where the match lies outside the right image.
    """
    height, width = from_left.shape
    known = np.isfinite(from_left)
    column = np.rint(np.arange(width) - np.where(known, from_left, 0)).astype(np.intp)
    known &= (column >= 0) & (column < width)
    partner = from_right[np.arange(height)[:, None], np.clip(column, 0, width - 1)]
    return np.where(known & np.isfinite(partner), np.abs(partner - from_left), np.inf).astype(np.float32)


def _match(near: Image, other: Image, lowest: int, highest: int, block: int) -> NDArray:
    """(H, W) disparity of `near`'s pixels, px; NaN where no match is unique."""
    count = -(-(highest - lowest + 1) // 16) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=block,
        P1=SMALL_STEP * block * block,
        P2=LARGE_STEP * block * block,
        disp12MaxDiff=-1,
        preFilterCap=CONTRAST_LIMIT,
        uniquenessRatio=UNIQUENESS_PERCENT,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # OpenCV leaves columns empty whose match could lie outside the image: add a margin.
    before, after = max(lowest + count, 0), max(-lowest, 0)
    wide = [cv2.copyMakeBorder(camera, 0, 0, before, after, cv2.BORDER_REPLICATE) for camera in (near, other)]
    sixteenths = matcher.compute(*wide)[:, before : before + near.shape[1]]
    return np.where(sixteenths >= 16 * lowest, sixteenths * np.float32(1 / 16), np.float32(np.nan))


@dataclass(frozen=True)
class StereoOrder:
    """Share of the image that matches in each order of the cameras, with positive depth; in [0, 1]."""

    as_given: float
    exchanged: float

    @property
    def swapped(self) -> bool:
        """Whether the first image is clearly that of the right camera."""
        return self.exchanged > self.as_given + CLEARLY

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        return f"{self.as_given:.0%} of the image matches as given, {self.exchanged:.0%} swapped"


def stereo_order(left_u8: Image, right_u8: Image) -> StereoOrder:
    """Match a rectified pair, (H, W, 3) each, as given and swapped: in the right order all disparities are positive."""
    left, right = _gray(left_u8, right_u8)
    height, width = left.shape
    scale = min(1.0, LOOK_WIDTH / width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    left, right = (np.asarray(cv2.resize(x, size, interpolation=cv2.INTER_AREA), np.uint8) for x in (left, right))
    # Exclude 0, the disparity of infinity, which black margins and burned-in text have in either order.
    highest = 1 + max(int(NEAREST_SHARE * size[0]), 16)
    agree = (
        disagreement(*match_both_ways(*pair, 1, highest, BLOCK_PX)) <= AGREE_PX
        for pair in ((left, right), (right, left))
    )
    return StereoOrder(*(float(each.mean()) for each in agree))


def vertical_offset_px(left_u8: Image, right_u8: Image) -> float:
    """Median |y_left - y_right| of matching features of a pair (H, W, 3), px, or NaN; below 0.5 if it is rectified."""
    offsets = np.abs(row_offsets_px(left_u8, right_u8))
    return float(np.median(offsets)) if len(offsets) >= MIN_MATCHES else float("nan")


def row_offsets_px(left_u8: Image, right_u8: Image) -> NDArray[np.float64]:
    """(N,) y_right - y_left of each matching feature, px; arguments as for `vertical_offset_px`."""
    (left, left_descriptors), (right, right_descriptors) = (
        keypoints(camera, FEATURES) for camera in _gray(left_u8, right_u8)
    )
    if min(len(left), len(right)) < MIN_MATCHES:
        return np.zeros(0)
    of_left, of_right = match_descriptors(left_descriptors, right_descriptors, RATIO)
    return right[of_right, 1].astype(np.float64) - left[of_left, 1]


def _gray(left_u8: Image, right_u8: Image) -> list[Image]:
    check_shape("left_u8:H,W,3 right_u8:H,W,3", left_u8=left_u8, right_u8=right_u8)
    return [np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8) for each in (left_u8, right_u8)]


STEEPEST = 1.0  # Neighbors of a row lie on one surface where their disparities differ by less than this, px per px
NEAREST = 0.5  # A tool without depth may be as near as this share of the smallest measured depth of the frame


def warp_to_right(
    rgb: NDArray[np.floating], disparity: NDArray[np.floating], tissue: Mask
) -> tuple[NDArray[np.floating], Mask]:
    """The left picture (H, W, 3) as the right eye sees it, bilinear; and (H, W) which pixels count, 0 elsewhere. All
    that is not tissue of the left image hides what is behind it.
    """
    seen, counted = seen_by_both(disparity, tissue)
    pixels = pixel_centers(disparity.shape[1], disparity.shape[0]).astype(np.float64)
    pixels[..., 0] += seen
    return np.where(counted[..., None], bilinear(rgb, pixels), 0).astype(rgb.dtype), counted


def seen_by_both(disparity: NDArray[np.floating], tissue: Mask) -> tuple[NDArray[np.float64], Mask]:
    """`right_disparity`, and (H, W) which of its pixels count: both eyes see tissue there and in the 8 pixels around.
    (Pixels on a silhouette mix the colors of two surfaces.)
    """
    seen = right_disparity(disparity, tissue)
    return seen, cv2.erode((seen > 0).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0


def measured_disparity(frame: Frame, baseline_mm: float) -> NDArray[np.float64]:
    """(H, W); 0 also where depth was clipped when it was read. Clipped depth is known by being the smallest or the
    largest of the frame. If all is equal, nothing was clipped.
    """
    depth = np.where(frame.depth_valid, frame.depth, 0).astype(np.float64)
    measured = depth[depth > 0]
    if measured.size and measured.min() < measured.max():
        depth[(depth == measured.min()) | (depth == measured.max())] = 0
    return np.divide(frame.camera.fx * baseline_mm, depth, out=np.zeros_like(depth), where=depth > 0)


def right_frame(frame: Frame, image_u8: Image, baseline_mm: float) -> Frame:
    """The frame of the right eye: its picture (H, W, 3), and as its tissue with depth what both eyes see."""
    seen, counted = seen_by_both(measured_disparity(frame, baseline_mm), frame.tissue_mask)
    depth = np.divide(frame.camera.fx * baseline_mm, seen, out=np.zeros_like(seen), where=counted)
    camera = right_camera(frame.camera, baseline_mm)
    return replace(
        frame, camera=camera, rgb_u8=image_u8, tissue_mask=counted, depth=depth.astype(np.float32), depth_valid=counted
    )


def right_disparity(disparity: NDArray[np.floating], tissue: Mask) -> NDArray[np.float64]:
    """(H, W) disparity of the tissue that both eyes see, at the pixel centers of the right image, px; 0 elsewhere.

    The left image's pixels are points of surfaces. Neighbors of a row on one surface are joined by a line, which is
    exact on planes; a point that is not joined to both sides covers the one pixel in which it lies. The nearest wins.
    """
    height, width = disparity.shape
    near = disparity.astype(np.float64)
    nearest, seen = np.zeros((height, width)), np.zeros((height, width), bool)
    rows, columns, values, of_tissue = _samples(near, tissue)
    np.maximum.at(nearest, (rows, columns), values)
    for is_tissue in (True, False):  # a tool at the same depth hides the tissue
        won = (values == nearest[rows, columns]) & (of_tissue == is_tissue)
        seen[rows[won], columns[won]] = is_tissue
    return np.where(seen & ~_maybe_hidden(near, tissue), nearest, 0)


def _samples(near: NDArray[np.float64], tissue: Mask) -> list[NDArray]:
    """Row, column, disparity, and whether it is tissue, of all that may be seen at pixels of the right image."""
    left, known = np.arange(near.shape[1]) + 0.5, near > 0
    joined = known[:, :-1] & known[:, 1:] & (np.abs(np.diff(near, axis=1)) < STEEPEST)
    both = np.pad(joined, ((0, 0), (1, 0))) & np.pad(joined, ((0, 0), (0, 1)))
    rows, at = np.nonzero(known & ~both)
    found = [(rows, np.floor(left[at] - near[rows, at]).astype(np.intp), near[rows, at], tissue[rows, at])]
    rows, at = np.nonzero(joined)
    begin, end = left[at] - near[rows, at], left[at + 1] - near[rows, at + 1]
    first = np.ceil(begin - 0.5)
    for step in (0, 1):  # a line is shorter than 2 px, and so passes at most two centers
        center = first + step + 0.5
        share = (center - begin) / (end - begin)
        values = near[rows, at] * (1 - share) + near[rows, at + 1] * share
        on = center <= end
        whole = tissue[rows, at] & tissue[rows, at + 1]
        found.append((rows[on], (first + step)[on].astype(np.intp), values[on], whole[on]))
    samples = [np.concatenate(parts) for parts in zip(*found, strict=True)]
    inside = (samples[1] >= 0) & (samples[1] < len(left))
    return [part[inside] for part in samples]


def _maybe_hidden(near: NDArray[np.float64], tissue: Mask) -> Mask:
    """(H, W) True where the right eye may see a tool whose depth is unknown, in place of what is measured there.

    Such are the tool's pixels without depth, and the part of a tool that goes on beyond the right border of the left
    image. Each may lie anywhere between the farthest tissue of the frame and `NEAREST` of the smallest depth.
    """
    height, width = near.shape
    measured = near[tissue & (near > 0)]
    hidden = np.zeros((height, width), bool)
    if not measured.size:
        return hidden
    least, most = measured.min(), near.max() / NEAREST
    beyond = np.repeat(~tissue[:, -1:], int(min(np.ceil(most), width)), 1)
    rows, at = np.nonzero(np.concatenate([~tissue & ~(near > 0), beyond], 1))
    begin = np.clip(np.floor(at + 0.5 - most), 0, width).astype(np.intp)
    end = np.clip(np.floor(at + 0.5 - least) + 1, 0, width).astype(np.intp)
    marks = np.zeros((height, width + 1), np.int64)
    np.add.at(marks, (rows, begin), 1)
    np.add.at(marks, (rows, end), -1)
    return np.cumsum(marks, 1)[:, :width] > 0
