"""Frames at a fraction of their size: colors are averaged; masks and depth are valid where the whole block is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera, Frame


def _steps(camera: Camera, factor: int) -> tuple[int, int]:
    """Columns and rows of the blocks that become one pixel: `factor`, or the whole side if it is shorter."""
    return min(factor, camera.width), min(factor, camera.height)


def shrunk_camera(camera: Camera, factor: int) -> Camera:
    """The camera of images that are `factor` times smaller: sizes rounded down, at least 1 px."""
    across, down = _steps(camera, factor)
    return replace(
        camera,
        width=camera.width // across,
        height=camera.height // down,
        fx=camera.fx / across,
        fy=camera.fy / down,
        cx=camera.cx / across,
        cy=camera.cy / down,
    )


def shrunk(frame: Frame, factor: int) -> Frame:
    """The frame at 1 / `factor` of its width and height, rounded down; a side shorter than `factor` becomes 1 px.

    A pixel is tissue, or has a depth, where all pixels of its block do; its depth is their mean.
    """
    if factor == 1:
        return frame
    camera, steps = shrunk_camera(frame.camera, factor), _steps(frame.camera, factor)
    width, height = camera.width, camera.height
    with np.errstate(over="ignore"):  # a mean beyond float32 counts as missing
        depth = _blocks(frame.depth, width, height, steps).mean((1, 3), dtype=np.float32)
    valid = _blocks(frame.depth_valid, width, height, steps).all((1, 3)) & np.isfinite(depth)
    rgb_u8 = frame.rgb_u8[: steps[1] * height, : steps[0] * width]
    return replace(
        frame,
        camera=camera,
        rgb_u8=cv2.resize(rgb_u8, (width, height), interpolation=cv2.INTER_AREA),
        tissue_mask=_blocks(frame.tissue_mask, width, height, steps).all((1, 3)),
        depth=np.where(valid, depth, np.float32(0)),
        depth_valid=valid,
    )


def _blocks(image: NDArray, width: int, height: int, steps: tuple[int, int]) -> NDArray:
    across, down = steps
    return image[: down * height, : across * width].reshape(height, down, width, across)
