"""The last step of every reader: which frames are kept, and a `Sequence` out of cameras and a decoder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config import DataConfig
from ..types import Camera, Frame
from .depth import clean_depth
from .images import complaint
from .sequence import Sequence
from .shrink import shrunk, shrunk_camera
from .truth import Truth

Pixels = tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]
"""(H, W, 3) color 0..255, (H, W) True on usable tissue, (H, W) depth in mm with 0 where it is missing."""


def kept_frames(count: int, cfg: DataConfig, own_stride: int = 1) -> range:
    """Positions, in the folder, of the frames that are read.

    Args:
        count: frames in the folder.
        cfg: `stride` and `first_frames`, which counts frames that are left after striding.
        own_stride: the dataset's published stride, used where `cfg.stride` is 0.
    """
    kept = range(0, count, cfg.stride or own_stride)
    return kept[: cfg.first_frames] if cfg.first_frames else kept


def assemble(
    path: Path,
    cfg: DataConfig,
    cameras: list[Camera],
    decode: Callable[[int], Pixels],
    *,
    files: list[Path],
    clip_depth: bool = True,
    frames_per_second: float | None = None,
    truth: Truth | None = None,
    remarks: list[str] | None = None,
    mask_folder: str = "masks",
    depth_is_relative: bool = False,
    sources: dict[str, str] | None = None,
) -> Sequence:
    """A lazy sequence of the kept frames, shrunk as configured.

    Args:
        path: the folder, for messages.
        cfg: `shrink` and how depth is cleaned.
        cameras: of the kept frames at full size.
        decode: pixels of kept frame i at full size.
        files: what the sequence is made of, for its fingerprint.
        clip_depth: clip each frame's depth to its percentiles (`clean_depth`); False where depth was measured or
            rendered, so that its extremes are real.
        frames_per_second, truth, remarks, mask_folder, depth_is_relative, sources: see `Sequence`.
    Raises:
        InputError: fewer than 2 frames, or no pixel, would be left.
    """
    count, width, height = len(cameras), cameras[0].width, cameras[0].height
    if count < 2 or min(width, height) // cfg.shrink < 1:
        hint = "Lower data.shrink or data.stride, or raise data.first_frames."
        raise complaint(path, "2 frames of 1x1 px to be left", f"{count} of {width}x{height} / {cfg.shrink}", hint)

    def read_frame(index: int) -> Frame:
        rgb_u8, tissue_mask, measured = decode(index)
        if clip_depth:
            depth, depth_valid = clean_depth(measured, cfg)
        else:
            depth, depth_valid = measured, measured > 0
        frame = Frame(index, index / count, cameras[index], rgb_u8, tissue_mask, depth, depth_valid)
        return shrunk(frame, cfg.shrink)

    return Sequence(
        path,
        [shrunk_camera(camera, cfg.shrink) for camera in cameras],
        read_frame,
        frames_per_second=frames_per_second,
        mask_folder=mask_folder,
        files=files,
        truth=truth,
        remarks=remarks,
        depth_is_relative=depth_is_relative,
        sources=sources,
    )
