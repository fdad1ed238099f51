"""Replace the masks of a folder that `prepare` is writing by those of a video segmenter, and the depth that needs them.

The frames are written first, with the masks of our own finder, because the segmenter goes through them in both
directions. Depth from shading depends on the masks, and so does the camera path, which is estimated afterwards.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.config import DataConfig
from ..data import load_sequence
from ..data.folder_edits import found_source, write_mask
from ..data.found_tools import FrameRow, write_rows
from ..data.images import read_color, save_png
from ..data.writer import TOOL_VALUE, FrameFiles
from ..tool_masks.carry import VideoSegmenter
from ..tool_masks.mask_store import MaskStore, read_state, write_state
from ..tool_masks.sequence import Progress
from ..tool_masks.video_segmenter import segment_sequence
from .frames import Depth, Mask

WORK = "carried"
"""Folder of the segmenter's masks until the sequence is complete, so that an interrupted run need not repeat them."""


def replace_by_carried(
    files: FrameFiles,
    segmenter: VideoSegmenter,
    inside: Mask,
    shade: Callable[[NDArray[np.uint8], Mask], Depth] | None,
    progress: Progress,
) -> list[str]:
    """Replace the masks of all written frames, their depth from shading, and the source of the masks in `files.meta`.

    Args:
        files: all frames are written. To call this again after an interruption gives the same files.
        inside: (H, W) True inside the endoscope's image.
        shade: depth from the shading of an image inside a mask; None if depth does not depend on masks.
    Returns:
        Notes for the user, one line each.
    """
    work = files.folder / WORK
    store = MaskStore(work / "masks", (files.meta.width, files.meta.height))
    state = read_state(work)
    if "rows" not in state:
        state = _carry(files, segmenter, work, store, progress)
    for i in range(files.count):
        mask = store.mask(i) | ~inside
        write_mask(files.file("masks", i), mask, TOOL_VALUE)
        if shade is not None:
            depth = np.where(inside, shade(read_color(files.file("images", i)), ~mask), np.float32(0))
            save_png(files.file("depth", i), files.depth_units(depth))
    rows = [FrameRow(**row) for row in state["rows"]]
    write_rows(files.folder, rows)
    with_tools = sum(row.share > 0 for row in rows)
    source = found_source(with_tools / files.count, segmenter.name)
    files.meta = replace(files.meta, sources=files.meta.sources | {"masks": source})
    return [f"masks: {source}. Check masks/, and correct them in `endoprior view` or any paint program (255 = tool)."]


def remove_carried(files: FrameFiles) -> None:
    """Remove the folder that lets an interrupted run resume; the sequence is complete without it."""
    shutil.rmtree(files.folder / WORK, ignore_errors=True)


def _carry(files: FrameFiles, segmenter: VideoSegmenter, work: Path, store: MaskStore, progress: Progress) -> dict:
    """Let the segmenter go over the frames, and note what it found in each."""
    files.finish()  # a reader needs the description; it is written again at the end
    rows = []
    sequence = load_sequence(files.folder, DataConfig(format="plain"))
    for i, (mask, found) in enumerate(segment_sequence(sequence, segmenter, work / "work", progress=progress)):
        store.put(i, mask)
        rows.append(asdict(FrameRow.of(i, found)))
    write_state(work, {"rows": rows})
    return read_state(work)
