"""Frames at a fraction of their size: colors averaged, masks and depth where the whole block agrees."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Camera, Frame


def shrunk_camera(camera: Camera, factor: int) -> Camera:
    """The camera of pictures that are `factor` times smaller, sizes rounded down."""
    return replace(
        camera,
        width=camera.width // factor,
        height=camera.height // factor,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
    )


def shrunk(frame: Frame, factor: int) -> Frame:
    """The frame at 1 / `factor` of its width and height, rounded down.

    A pixel is tissue, or has a depth, where all `factor` x `factor` pixels of its block do; its depth is their mean.
    """
    if factor == 1:
        return frame
    camera = shrunk_camera(frame.camera, factor)
    width, height = camera.width, camera.height
    valid = _blocks(frame.depth_valid, width, height, factor).all((1, 3))
    depth = _blocks(frame.depth, width, height, factor).mean((1, 3), dtype=np.float32)
    rgb_u8 = frame.rgb_u8[: factor * height, : factor * width]
    return replace(
        frame,
        camera=camera,
        rgb_u8=cv2.resize(rgb_u8, (width, height), interpolation=cv2.INTER_AREA),
        tissue_mask=_blocks(frame.tissue_mask, width, height, factor).all((1, 3)),
        depth=np.where(valid, depth, np.float32(0)),
        depth_valid=valid,
    )


def _blocks(image: NDArray, width: int, height: int, factor: int) -> NDArray:
    return image[: factor * height, : factor * width].reshape(height, factor, width, factor)
