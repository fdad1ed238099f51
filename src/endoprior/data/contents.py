"""What the files of a sequence hold: whether frames can be trained on, and whether a file changed since then."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ..core.checks import input_error
from ..core.types import Frame
from ..footage.image_operations import Image, Mask, smallest_channel, square
from .image_folders import has_depth, how_to_add_depth
from .reading import reading

State = tuple[int, int, int] | None


def state_of(file: Path) -> State:
    """What changes with the contents of a file, without reading them; None if there is no such file."""
    try:
        facts = file.stat()
    except OSError:
        return None
    return facts.st_mtime_ns, facts.st_ctime_ns, facts.st_size


def demand_same(files: Sequence[Path], states: Sequence[State], before: Sequence[State]) -> None:
    """Raise InputError if the state of a file is not what it was before."""
    for file, now, then in zip(files, states, before, strict=True):
        if now != then:
            fix = "Put the data back and resume, or train on the new data in a new folder."
            raise input_error(file, "data that stays as it is during training", "a file that was changed", fix)


def fingerprint_of(files: Sequence[Path], folder: Path) -> str:
    """SHA-256, in hex, of the names (below the folder) and contents of files."""
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(os.fsencode(file.relative_to(folder).as_posix()) + b"\0")
        with reading(file), file.open("rb") as content:
            digest.update(hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()


class FrameContents(NamedTuple):
    """What of a frame can be trained on."""

    tissue: float  # its share of the pixels
    has_depth: bool  # anywhere, on tools too
    num_measured: int  # tissue pixels with depth
    num_colored: int  # those of them whose color is not saturated


def frame_contents(frame: Frame) -> FrameContents:
    """What of a frame can be trained on."""
    measured = frame.depth_valid & frame.tissue_mask
    colored = measured & ~is_saturated(frame.rgb_u8)
    num_measured, num_colored = int(np.count_nonzero(measured)), int(np.count_nonzero(colored))
    return FrameContents(float(frame.tissue_mask.mean()), bool(frame.depth_valid.any()), num_measured, num_colored)


def demand_trainable(
    frames: Sequence[FrameContents], train: Sequence[int], path: Path, mask_name: str, *, is_plain: bool
) -> None:
    """Raise InputError if the frames of a sequence cannot be trained on.

    Args:
        train: indices of the training frames. path: folder of the sequence. mask_name: of the folder of masks in it.
        is_plain: whether the folder has the layout `plain`, which images without depth have, too.
    """
    masks, depth = path / mask_name, path / "depth"
    if not any(frame.tissue for frame in frames):
        hint = "the polarity may be inverted: masks are 255 on tools."
        raise input_error(masks, "tissue in at least one frame", "tool everywhere", hint)
    if not any(frame.has_depth for frame in frames):
        got = "0 everywhere" if has_depth(path) else "none"
        fix = how_to_add_depth(path, is_plain=is_plain)
        raise input_error(depth, "depth > 0 in at least one frame", got, fix)
    if not any(frames[index].num_measured for index in train):
        hint = "the mask's polarity may be inverted, or the depth may be of the tool only."
        raise input_error(depth, "depth on tissue in a training frame", "none", hint)
    share = sum(frames[index].num_colored for index in train) / sum(frames[index].num_measured for index in train)
    if share < MIN_COLORED:
        want = f"a level below {SATURATED} of 255 on at least {MIN_COLORED:.0%} of the tissue in the training frames"
        hint = "export the images again, with all values from 0 to 255 in use, or choose a darker part of the video."
        raise input_error(path, want, f"{share:.1%}: the images are white", hint)


SATURATED = 250  # a pixel is saturated if its smallest channel reaches this level: its color is at least as bright
SATURATED_SHARE = 0.02  # least share of tissue that is, else it is the usual highlights, which are to be modelled
MIN_COLORED = 0.01  # with a smaller share of the tissue that is not saturated, there is nothing to train on
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
