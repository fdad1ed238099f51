"""Frames at a fraction of their size: colors are averaged; masks and depth are valid where the whole block is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera, Frame


def _steps(width: int, height: int, factor: int) -> tuple[int, int]:
    """Columns and rows of the blocks that become one pixel: `factor`, or the whole side if it is shorter."""
    return min(factor, width), min(factor, height)


def shrunk_camera(camera: Camera, factor: int) -> Camera:
    """The camera of images that are `factor` times smaller: sizes rounded down, at least 1 px."""
    across, down = _steps(camera.width, camera.height, factor)
    return replace(
        camera,
        width=camera.width // across,
        height=camera.height // down,
        fx=camera.fx / across,
        fy=camera.fy / down,
        cx=camera.cx / across,
        cy=camera.cy / down,
    )


def shrunk_color(rgb_u8: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """(H, W, 3) color at 1 / `factor` of its size, as `shrunk` has it: each pixel is the mean of its block."""
    if factor == 1:
        return rgb_u8
    across, down = _steps(rgb_u8.shape[1], rgb_u8.shape[0], factor)
    width, height = rgb_u8.shape[1] // across, rgb_u8.shape[0] // down
    return cv2.resize(rgb_u8[: down * height, : across * width], (width, height), interpolation=cv2.INTER_AREA)


def shrunk(frame: Frame, factor: int) -> Frame:
    """The frame at 1 / `factor` of its width and height, rounded down; a side shorter than `factor` becomes 1 px.

    A pixel is tissue, or has a depth, where all pixels of its block do; its depth is their mean.
    """
    if factor == 1:
        return frame
    camera = shrunk_camera(frame.camera, factor)
    steps, width, height = _steps(frame.camera.width, frame.camera.height, factor), camera.width, camera.height
    with np.errstate(over="ignore"):  # a mean beyond float32 counts as missing
        depth = _blocks(frame.depth, width, height, steps).mean((1, 3), dtype=np.float32)
    valid = _blocks(frame.depth_valid, width, height, steps).all((1, 3)) & np.isfinite(depth)
    return replace(
        frame,
        camera=camera,
        rgb_u8=shrunk_color(frame.rgb_u8, factor),
        tissue_mask=_blocks(frame.tissue_mask, width, height, steps).all((1, 3)),
        depth=np.where(valid, depth, np.float32(0)),
        depth_valid=valid,
    )


def _blocks(image: NDArray, width: int, height: int, steps: tuple[int, int]) -> NDArray:
    across, down = steps
    return image[: down * height, : across * width].reshape(height, down, width, across)
