"""What the right camera of a stereo pair sees, from the image and the depth of the left one.

A point at column x of the left image is at column x - disparity of the right one; disparity is fx baseline / z, px,
(H, W), and 0 where no depth was measured. `H, W` image size.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import bilinear, pixel_centers, right_camera
from ..core.types import Frame
from ..footage.image_operations import Image, Mask

STEEPEST = 1.0  # Neighbors of a row lie on one surface where their disparities differ by less than this, px per px
NEAREST = 0.5  # A tool without depth may be as near as this share of the smallest measured depth of the frame


def warp_to_right(
    rgb: NDArray[np.floating], disparity: NDArray[np.floating], tissue: Mask
) -> tuple[NDArray[np.floating], Mask]:
    """The left image (H, W, 3) as the right camera sees it, bilinear; and (H, W) which pixels count, 0 elsewhere. All
    that is not tissue of the left image hides what is behind it.
    """
    seen, counted = seen_by_both(disparity, tissue)
    pixels = pixel_centers(disparity.shape[1], disparity.shape[0]).astype(np.float64)
    pixels[..., 0] += seen
    return np.where(counted[..., None], bilinear(rgb, pixels), 0).astype(rgb.dtype), counted


def seen_by_both(disparity: NDArray[np.floating], tissue: Mask) -> tuple[NDArray[np.float64], Mask]:
    """`right_disparity`, and (H, W) which of its pixels count: both see tissue there and in the 8 pixels around.
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
    """The frame of the right camera: its image (H, W, 3), and as its tissue with depth what both cameras see."""
    seen, counted = seen_by_both(measured_disparity(frame, baseline_mm), frame.tissue_mask)
    depth = np.divide(frame.camera.fx * baseline_mm, seen, out=np.zeros_like(seen), where=counted)
    camera = right_camera(frame.camera, baseline_mm)
    return replace(
        frame, camera=camera, rgb_u8=image_u8, tissue_mask=counted, depth=depth.astype(np.float32), depth_valid=counted
    )


def right_disparity(disparity: NDArray[np.floating], tissue: Mask) -> NDArray[np.float64]:
    """(H, W) disparity of the tissue that both cameras see, at the pixel centers of the right image, px; 0 elsewhere.

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
    """(H, W) True where the right camera may see a tool whose depth is unknown, in place of what is measured there.

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
