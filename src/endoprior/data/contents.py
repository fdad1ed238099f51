"""What the files of a sequence hold: whether frames can be trained on, and whether a file changed since then."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..core.checks import input_error
from ..core.types import Frame
from ..footage.components import Image, Mask, square
from ..footage.dark_outline import brightness
from ..system.memory import workers
from .image_folders import has_depth, how_to_add_depth
from .reading import reading

if TYPE_CHECKING:
    from .sequence import FrameSequence

DECODING_BYTES = 40  # memory per pixel while a frame is read
TOOL_FRACTION_WARNING = 0.6  # with a larger share of tool pixels, the mask is probably inverted
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


def remarks_on(sequence: FrameSequence, decoded: Callable[[int], Frame]) -> list[str]:
    """What is unusual but usable in the frames, one line each; InputError if they cannot be trained on."""

    def contents(index: int) -> tuple[float, bool, int, int]:
        """Share of tissue; whether any pixel has depth; how many tissue pixels have depth, and a color besides."""
        frame = decoded(index)
        measured = frame.depth_valid & frame.tissue_mask
        colored = measured & ~is_saturated(frame.rgb_u8)
        num_measured, num_colored = int(np.count_nonzero(measured)), int(np.count_nonzero(colored))
        return float(frame.tissue_mask.mean()), bool(frame.depth_valid.any()), num_measured, num_colored

    camera, count = sequence.camera(0), len(sequence)
    masks, depth = sequence.path / sequence.mask_name, sequence.path / "depth"
    with ThreadPoolExecutor(workers(DECODING_BYTES * camera.width * camera.height)) as pool:
        # Decoding releases the interpreter lock.
        tissue, with_depth, with_both, colored = zip(*pool.map(contents, range(count)), strict=True)
    if not any(tissue):
        hint = "the polarity may be inverted: masks are 255 on tools."
        raise input_error(masks, "tissue in at least one frame", "tool everywhere", hint)
    if not any(with_depth):
        got = "0 everywhere" if has_depth(sequence.path) else "none"
        raise input_error(depth, "depth > 0 in at least one frame", got, how_to_add_depth(sequence.path))
    train = sequence.indices("train")
    if not any(with_both[index] for index in train):
        hint = "the mask's polarity may be inverted, or the depth may be of the tool only."
        raise input_error(depth, "depth on tissue in a training frame", "none", hint)
    share = sum(colored[index] for index in train) / sum(with_both[index] for index in train)
    if share < LEAST_COLORED:
        want = f"a level below {SATURATED} of 255 on at least {LEAST_COLORED:.0%} of the tissue in the training frames"
        hint = "export the images again, with all values from 0 to 255 in use, or choose a darker part of the video."
        raise input_error(sequence.path, want, f"{share:.1%}: the images are white", hint)
    remarks = list(sequence.remarks)
    if (tool := 1 - sum(tissue) / count) > TOOL_FRACTION_WARNING:
        remarks.append(f"{masks}: {tool:.0%} of all pixels are masked; the polarity may be inverted")
    if sequence.depth_is_relative:
        remarks.append(f"{sequence.path}: the scale of its depth is unknown or assumed; lengths are not millimeters")
    if sequence.scale is not None:
        remarks.append(f"{sequence.path}: scale by {sequence.scale.text}")
    if empty := [index for index in range(count) if not with_both[index]]:
        remarks.append(f"{sequence.path}: {len(empty)} frames have no depth on tissue, the first is frame {empty[0]}")
    return remarks


SATURATED = 250  # a pixel is saturated if its smallest channel reaches this level: its color is at least as bright
SATURATED_SHARE = 0.02  # least share of tissue that is, else it is the usual highlights, which are to be modelled
LEAST_COLORED = 0.01  # with a smaller share of the tissue that is not saturated, there is nothing to train on
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
    return ~brightness(~rgb_u8) >= SATURATED


def weighted(frame: Frame, weight: float) -> Frame:
    """The frame with its weight on every pixel, and less where it is overexposed; itself where all are 1."""
    saturated = overexposed(frame)
    if weight == 1 and saturated is None:
        return frame
    believed = np.full(frame.tissue_mask.shape, weight, np.float32)
    if saturated is not None:
        believed[cv2.dilate(saturated.astype(np.uint8), square(GLARE_PX)) > 0] *= GLARE_WEIGHT
    return replace(frame, weight=believed)
