"""The last step of every reader: select frames, and build a `FrameSequence` from cameras and a decoder."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error, read_ranges
from ..core.config import DataConfig
from ..core.geometry import FARTHEST_MM
from ..core.types import Camera, Frame
from .pixels import clean_depth, shrunk, shrunk_camera
from .sequence import FrameSequence
from .truth import RightEye

Pixels = tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]
"""(H, W, 3) color 0..255, (H, W) True on usable tissue, (H, W) depth in mm with 0 where it is missing."""
MIN_FOCAL_PX, MAX_LENS_PX = 1e-2, 1e6  # of focal lengths; the upper one also of principal points


def kept_frames(count: int, cfg: DataConfig, own_stride: int = 1, having: Sequence[Container[int]] = ()) -> list[int]:
    """Positions of the frames to read in a folder of `count`, by stride, then first frames, then skipped frames.

    Without a stride the dataset's published one counts. Frames that are not in all of `having` are left out.
    """
    kept = range(0, count, cfg.stride or own_stride)
    kept = kept[: cfg.first_frames] if cfg.first_frames else kept
    skipped = read_ranges("skip_frames", cfg.skip_frames)
    left = [frame for position, frame in enumerate(kept) if position not in skipped]
    if kept and not left:
        want = f"frames that leave some of 0 to {len(kept) - 1}"
        raise input_error("data.skip_frames", want, cfg.skip_frames, "shorten it, or leave it out for all frames.")
    return [frame for frame in left if all(frame in each for each in having)]


def assemble(
    path: Path,
    cfg: DataConfig,
    cameras: list[Camera],
    decode: Callable[[int], Pixels],
    *,
    images: list[Path],
    files: Sequence[Path] = (),
    clip_depth: bool = True,
    confidence: Callable[[int], NDArray[np.float32]] | None = None,
    right_eye: RightEye | None = None,
    mask_folder: str = "masks",
    mask_files: Sequence[Path] = (),
    new_mask_files: Sequence[Path] = (),
    **about: Any,
) -> FrameSequence:
    """A lazy sequence of the kept frames, shrunk as configured.

    Args:
        path: the folder, for messages.
        cfg: `shrink` and how depth is cleaned.
        cameras: of the kept frames at full size.
        decode: pixels of kept frame i at full size.
        images: the color image of each kept frame.
        files: the other files of the sequence, for its fingerprint.
        clip_depth: clip each frame's depth to its percentiles (`clean_depth`); False where the extremes of depth are
            reliable, because it was measured or rendered.
        confidence: of the depth of kept frame i, see `Frame.depth_confidence`.
        right_eye, mask_folder, mask_files, new_mask_files: see `FrameSequence`; at full size.
        about: `frames_per_second`, `truth`, `remarks`, `mask_tool_value`, `depth_is_relative`, `scale`, `sources` of
            `FrameSequence`.
    Raises:
        InputError: fewer than 2 frames or no pixel would be left, or a camera has impossible numbers.
    """
    count, width, height = len(cameras), cameras[0].width, cameras[0].height
    if count < 2 or min(width, height) // cfg.shrink < 1:
        hint = "lower data.shrink or data.stride, raise data.first_frames, or shorten data.skip_frames."
        raise input_error(path, "at least 2 frames of 1x1 px", f"{count} of {width}x{height} / {cfg.shrink}", hint)
    for index, camera in enumerate(cameras):  # finite numbers may still overflow in the renderer
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        if not (all(abs(value) <= MAX_LENS_PX for value in lens) and min(camera.fx, camera.fy) >= MIN_FOCAL_PX):
            want = f"fx, fy, cx, cy up to {MAX_LENS_PX:g} px, fx and fy at least {MIN_FOCAL_PX:g}"
            got = ", ".join(f"{value:g}" for value in lens)
            raise input_error(path, want, f"{got} in frame {index}", "correct the intrinsics.")
        far = np.abs(camera.world_to_camera[:3, 3]).max()
        if not far <= FARTHEST_MM:
            want, got = f"cameras within {FARTHEST_MM:g} mm of the origin", f"{far:g} mm in frame {index}"
            raise input_error(path, want, got, "correct the poses.")

    def read_frame(index: int) -> Frame:
        rgb_u8, tissue_mask, measured = decode(index)
        depth, depth_valid = clean_depth(measured, cfg) if clip_depth else (measured, measured > 0)
        frame = Frame(index, index / count, cameras[index], rgb_u8, tissue_mask, depth, depth_valid)
        if confidence is not None:
            frame = replace(frame, depth_confidence=confidence(index))
        return shrunk(frame, cfg.shrink)

    return FrameSequence(
        path,
        [shrunk_camera(camera, cfg.shrink) for camera in cameras],
        read_frame,
        image_files=images,
        files=[*images, *files, *(right_eye.files if right_eye else [])],
        right_eye=right_eye,
        mask_name=mask_folder,
        mask_files=list(mask_files) if cfg.shrink == 1 else [],
        new_mask_files=list(new_mask_files) if cfg.shrink == 1 else [],
        **about,
    )
