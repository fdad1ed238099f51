"""What the files of a sequence hold: whether frames can be trained on, and whether a file changed since then."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..core.types import Frame
from ..system.memory import workers
from .reading import reading

if TYPE_CHECKING:
    from .sequence import FrameSequence
from dataclasses import replace

import cv2
import numpy as np

from ..footage.components import square
from ..footage.dark_outline import brightness

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

    def contents(index: int) -> tuple[float, bool, bool]:
        """Share of tissue; whether any pixel has depth; whether any tissue pixel has depth."""
        frame = decoded(index)
        measured = frame.depth_valid & frame.tissue_mask
        return float(frame.tissue_mask.mean()), bool(frame.depth_valid.any()), bool(measured.any())

    camera, count = sequence.camera(0), len(sequence)
    masks, depth = sequence.path / sequence.mask_name, sequence.path / "depth"
    with ThreadPoolExecutor(workers(DECODING_BYTES * camera.width * camera.height)) as pool:
        # Decoding releases the interpreter lock.
        tissue, with_depth, with_both = zip(*pool.map(contents, range(count)), strict=True)
    if not any(tissue):
        hint = "the polarity may be inverted: masks are 255 on tools."
        raise input_error(masks, "tissue in at least one frame", "tool everywhere", hint)
    if not any(with_depth):
        hint = "provide depth in mm, 0 where it is missing."
        raise input_error(depth, "depth > 0 in at least one frame", "0 everywhere", hint)
    if not any(with_both[index] for index in sequence.indices("train")):
        hint = "the mask's polarity may be inverted, or the depth may be of the tool only."
        raise input_error(depth, "depth on tissue in a training frame", "none", hint)
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


SATURATED = 250  # a pixel is saturated, and says nothing of the tissue, if its smallest channel reaches this level
SATURATED_SHARE = 0.02  # least share of tissue that is, else it is the usual highlights, which are to be modelled
GLARE_PX = 2  # so far around saturated pixels their light spreads


def weighted(frame: Frame, weight: float) -> Frame:
    """The frame with its weight on every pixel, and with 0 where much of it is saturated; itself where all are 1."""
    saturated = (~brightness(~frame.rgb_u8) >= SATURATED) & frame.tissue_mask
    glares = np.count_nonzero(saturated) > SATURATED_SHARE * max(np.count_nonzero(frame.tissue_mask), 1)
    if weight == 1 and not glares:
        return frame
    believed = np.full(frame.tissue_mask.shape, weight, np.float32)
    if glares:
        believed[cv2.dilate(saturated.astype(np.uint8), square(GLARE_PX)) > 0] = 0
    return replace(frame, weight=believed)
