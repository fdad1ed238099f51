"""Real frames with labels, by the hospital, scope and instruments that they come from.

`ENDOPRIOR_DATA` holds the clips: `bowel_lift` (masks), `vocalfolds` (labels by hand), `mono_endo.mp4` (a part without
tools), `wild` (clips without tools). What is trained for one set has not seen that set; `wild` is never trained on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from endoprior.data.images import decode_image, read_color, read_tool_mask
from endoprior.data.video_files import open_container
from endoprior.footage.border import find_outline

from .benchmark import TestFrame
from .composites import IGNORED, LabeledFrame

LONG_SIDE_PX = 420
"""Training frames are held at this size: parts of them become examples of 256 px."""
TOOL_FREE = range(97, 148)
"""Frames of `mono_endo` without a tool."""
DARK, DARK_PX = 25, 25
"""Largest level and least width of what is black around a round image."""
WILD = ("colon_polyp", "colon_boxes", "fetoscopy", "broncho_phantom")
"""Clips without a tool."""
WILD_FRAMES = 12
"""Of each of them."""
Labeled = tuple[str, NDArray[np.uint8], NDArray[np.uint8]]
"""Name, (H, W, 3) image, (H, W) label: 0, 1 (tool) or `IGNORED`."""


def bowel_lift(root: Path) -> Iterator[Labeled]:
    """Robotic, porcine: every third frame; the burned-in label is ignored."""
    for file in sorted((root / "bowel_lift" / "images").glob("*.png"))[::3]:
        label = read_tool_mask(root / "bowel_lift" / "masks" / file.name).astype(np.uint8)
        label[:50, :110] = IGNORED
        yield file.stem, read_color(file), label


def vocalfolds(root: Path) -> Iterator[Labeled]:
    """Laryngeal operations: instruments, dressings and tubes are tools, void is ignored."""
    table = np.zeros(256, np.uint8)
    table[0], table[5], table[6] = IGNORED, 1, 1
    for file in sorted((root / "vocalfolds").glob("*/images/*.jpg")):
        label = decode_image(file.parent.parent / "labels" / f"{file.stem}.png", None)
        yield f"{file.parent.parent.name} {file.stem}", read_color(file), table[label]


def mono_endo(root: Path) -> Iterator[Labeled]:
    """Laparoscopy, the part without tools: every third frame."""
    yield from _without_tools(root / "mono_endo.mp4", TOOL_FREE[::3])


def wild(root: Path) -> Iterator[Labeled]:
    """Clips without tools of four kinds of scopes."""
    for name in WILD:
        path = root / "wild" / f"{name}.mp4"
        with open_container(path) as container:
            total = container.streams.video[0].frames
        yield from _without_tools(path, range(0, total, max(total // WILD_FRAMES, 1)))


def _without_tools(path: Path, wanted: range) -> Iterator[Labeled]:
    """Frames without a tool; black beyond the border is ignored."""
    with open_container(path) as container:
        for i, picture in enumerate(container.decode(video=0)):
            if i in wanted:
                image = picture.to_ndarray(format="rgb24")
                kernel = np.ones((DARK_PX, DARK_PX), np.uint8)
                dark = cv2.morphologyEx((image.max(-1) < DARK).astype(np.uint8), cv2.MORPH_OPEN, kernel)
                yield f"{path.stem} {i}", image, np.where(dark > 0, IGNORED, 0).astype(np.uint8)


SETS: dict[str, Callable[[Path], Iterator[Labeled]]] = {
    "bowel_lift": bowel_lift,
    "vocalfolds": vocalfolds,
    "mono_endo": mono_endo,
    "wild": wild,
}
TRAINED = ("bowel_lift", "vocalfolds", "mono_endo")
"""Sets whose frames may be trained on."""


def training_frames(root: Path, names: Sequence[str]) -> list[list[LabeledFrame]]:
    """The frames of each named set, at the size of the training."""
    return [[_for_training(rgb_u8, label) for _, rgb_u8, label in SETS[name](root)] for name in names]


def test_frames(root: Path, name: str) -> Iterator[TestFrame]:
    """The frames of a set with their truth; the border of the view is found as by `prepare`."""
    for _, clip in groupby(SETS[name](root), key=lambda labeled: labeled[0].rpartition(" ")[0]):
        frames = list(clip)
        outline = find_outline([rgb_u8 for _, rgb_u8, _ in frames])
        view = ~(outline.in_strip | outline.outside)
        for title, rgb_u8, label in frames:
            yield TestFrame(title, np.ascontiguousarray(rgb_u8), view, label == 1, label != IGNORED)


def _for_training(rgb_u8: NDArray[np.uint8], label: NDArray[np.uint8]) -> LabeledFrame:
    scale = LONG_SIDE_PX / max(label.shape)
    size = (round(label.shape[1] * scale), round(label.shape[0] * scale))
    return LabeledFrame(
        cv2.resize(rgb_u8, size, interpolation=cv2.INTER_AREA), cv2.resize(label, size, interpolation=cv2.INTER_NEAREST)
    )
