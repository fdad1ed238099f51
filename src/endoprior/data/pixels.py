"""Decoded pixels made ready: which depth is measured, outliers clipped, overexposed pixels weighted less, frames at a
fraction of their size.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.config import DataConfig
from ..core.types import SURE_DEPTH, Camera, Frame
from ..footage.image_operations import Image, Mask, smallest_channel, square

GAP = 1.5  # a number is a filling if it is larger than all others by this factor ...
MIN_FAR_PIXELS = 8  # ... and occurs in at least so many pixels, which measured depth at such a distance does not
FARTHEST = 20.0  # depth beyond so many times the median of an image is an error of measurement
CLIP_PERCENTILES = (3.0, 99.8)  # measured depths of a frame are clipped to these percentiles of themselves
MIN_MEDIAN_PIXELS = 100  # the median of fewer says nothing
STEPS_APART = 4.0  # a flat patch is filled if its edge is so many times as high as the usual step between two pixels
USUAL_STEPS = 90  # percentile of the steps that are not 0: edges of tools are among them, and are no usual ones


def is_matte(alpha: NDArray) -> bool:
    """Whether an alpha channel makes a part of its image transparent. One that is the same everywhere shows all of it.

    Args:
        alpha: of any shape and type; empty if there is none.
    """
    return bool(alpha.size and alpha.min() < alpha.max())


def is_measured(stored: NDArray, *, relative: bool = False) -> NDArray[np.bool_]:
    """(H, W) True where a depth file holds a measurement.

    Missing is what is not finite, 0 or less; the largest number of a type of 16 bits or more; a largest number that
    occurs often and is far above all others, such as 10000 or 1e6, or that fills flat patches behind an edge
    (`_is_filling`); and single numbers far above the median.

    Args:
        stored: (H, W) numbers of any type, in any unit.
        relative: the depth is only scaled, so that the largest number of a type may be the farthest pixel.
    """
    with np.errstate(invalid="ignore"):  # NaN compares as missing
        measured = np.isfinite(stored) & (stored > 0)
    if stored.dtype.kind in "iu" and stored.dtype.itemsize > 1 and not relative:
        measured &= stored != np.iinfo(stored.dtype).max
    while measured.any():
        values = stored[measured]
        largest = values.max()
        is_largest = values == largest
        is_far = MIN_FAR_PIXELS <= is_largest.sum() < values.size and largest > GAP * float(values[~is_largest].max())
        if is_far or (not relative and _is_filling(stored, measured, largest)):
            measured &= stored != largest
            continue
        if values.size < MIN_MEDIAN_PIXELS or largest <= FARTHEST * float(values.min()):  # then none is beyond
            break
        return measured & (stored <= FARTHEST * float(np.median(values)))
    return measured


def _is_filling(stored: NDArray, measured: NDArray[np.bool_], number: float) -> bool:
    """Whether the largest number fills holes: in flat patches, whose edges are far higher than the steps of the rest.

    A sensor writes the end of its range, such as 255, 4095 or 65534, where it measured nothing. Measured depth that was
    clipped has no such edge around the number that it was clipped to.
    """
    filled = measured & (stored == number)
    has_patch = cv2.erode(filled.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0).any()
    rest = measured & ~filled
    if not has_patch or not MIN_MEDIAN_PIXELS <= rest.sum() > filled.sum():
        return False
    values, steps, edges = np.where(measured, stored, 0).astype(np.float64), [], []
    for now, before in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        apart = np.abs(values[now] - values[before])
        steps.append(apart[rest[now] & rest[before] & (apart > 0)])
        edges.append(apart[(filled[now] & rest[before]) | (rest[now] & filled[before])])
    usual, edge = np.concatenate(steps), np.concatenate(edges)
    return bool(usual.size and edge.size and np.median(edge) > STEPS_APART * np.percentile(usual, USUAL_STEPS))


def clean_depth(
    raw: NDArray[np.floating], cfg: DataConfig | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Separate measured from missing depth, and clip the measured values to two of their own percentiles.

    Args:
        raw: (H, W) depth, mm; missing where 0, negative or not finite.
        cfg: `lift_missing_depth` treats missing depth as near, as EndoGaussian does.
    Returns:
        (H, W) depth, mm, 0 where missing, and (H, W) bool, True where measured. A frame without any measured depth
        is all 0 and False, lifted or not.
    """
    cfg = cfg or DataConfig()
    raw = np.asarray(raw, np.float32)
    valid = np.isfinite(raw) & (raw > 0)
    measured = raw[valid]
    if measured.size == 0:
        return np.zeros_like(raw), valid
    near, far = np.percentile(measured, CLIP_PERCENTILES)
    missing = near if cfg.lift_missing_depth else 0
    depth = np.where(valid, np.clip(raw, np.float32(near), np.float32(far)), np.float32(missing))
    return depth, np.ones_like(valid) if cfg.lift_missing_depth else valid


def measured_share(frames: Iterable[Frame]) -> float | None:
    """Mean share of the tissue of frames whose depth was measured surely; None where depth has no confidence."""
    shares = [
        np.count_nonzero(frame.tissue_mask & (frame.depth_confidence > SURE_DEPTH))
        / max(np.count_nonzero(frame.tissue_mask), 1)
        for frame in frames
        if frame.depth_confidence is not None
    ]
    return sum(shares) / len(shares) if shares else None


SATURATED = 250  # a pixel is saturated if its smallest channel reaches this level: its color is at least as bright
SATURATED_SHARE = 0.02  # least share of tissue that is, else it is the usual highlights, which are to be modelled
GLARE_PX = 2  # so far around saturated pixels their light spreads
GLARE_WEIGHT = 0.5
"""How far such pixels are believed beside others. Other frames may show the true color; but what no frame shows better
needs a color, else there is a hole, and with far less what is white most of the time becomes dark."""


def overexposed(frame: Frame) -> Mask | None:
    """(H, W) True on saturated tissue; None where that is no more than the usual highlights."""
    saturated = is_saturated(frame.rgb_u8) & frame.tissue_mask
    glares = np.count_nonzero(saturated) > SATURATED_SHARE * max(np.count_nonzero(frame.tissue_mask), 1)
    return saturated if glares else None


def is_saturated(rgb_u8: Image) -> Mask:
    """(H, W) True where an image (H, W, 3) is saturated."""
    return smallest_channel(rgb_u8) >= SATURATED


def weighted(frame: Frame, weight: float) -> Frame:
    """The frame with its weight on every pixel, and less where it is overexposed; itself where all are 1."""
    saturated = overexposed(frame)
    if weight == 1 and saturated is None:
        return frame
    believed = np.full(frame.tissue_mask.shape, weight, np.float32)
    if saturated is not None:
        believed[cv2.dilate(saturated.astype(np.uint8), square(GLARE_PX)) > 0] *= GLARE_WEIGHT
    return replace(frame, weight=believed)


def shrunk_camera(camera: Camera, factor: int) -> Camera:
    """The camera of images that are `factor` times smaller: sizes rounded down, at least 1 px."""
    across, down = min(factor, camera.width), min(factor, camera.height)
    width, height = camera.width // across, camera.height // down
    lens = {"fx": camera.fx / across, "fy": camera.fy / down, "cx": camera.cx / across, "cy": camera.cy / down}
    return replace(camera, width=width, height=height, **lens)


def shrunk_color(rgb_u8: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """(H, W, 3) color at 1 / `factor` of its size, as `shrunk` has it: each pixel is the mean of its block."""
    if factor == 1:
        return rgb_u8
    blocks = _blocks(rgb_u8[..., 0], factor)
    height, down, width, across = blocks.shape
    whole = rgb_u8[: down * height, : across * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def shrunk(frame: Frame, factor: int) -> Frame:
    """The frame at 1 / `factor` of its width and height, rounded down; a side shorter than `factor` becomes 1 px.

    A pixel is tissue, or has a depth, where all pixels of its block do; its depth is their mean.
    """
    if factor == 1:
        return frame
    with np.errstate(over="ignore"):  # a mean beyond float32 counts as missing
        depth = _blocks(frame.depth, factor).mean((1, 3), dtype=np.float32)
    valid = _blocks(frame.depth_valid, factor).all((1, 3)) & np.isfinite(depth)
    means = {
        name: _blocks(values, factor).mean((1, 3), dtype=np.float32)
        for name in ("weight", "depth_confidence")
        if (values := getattr(frame, name)) is not None
    }
    return replace(
        frame,
        camera=shrunk_camera(frame.camera, factor),
        rgb_u8=shrunk_color(frame.rgb_u8, factor),
        tissue_mask=_blocks(frame.tissue_mask, factor).all((1, 3)),
        depth=np.where(valid, depth, np.float32(0)),
        depth_valid=valid,
        **means,
    )


def _blocks(image: NDArray, factor: int) -> NDArray:
    """(height, down, width, across) view of the blocks of (H, W) that become one pixel, whole ones only."""
    down, across = (min(factor, side) for side in image.shape)
    height, width = image.shape[0] // down, image.shape[1] // across
    return image[: down * height, : across * width].reshape(height, down, width, across)
