"""Frames with labels: real ones, by the hospital, scope and instruments that they come from, and those of phantoms.

`ENDOPRIOR_DATA` holds the clips: `bowel_lift` (masks), `vocalfolds` (labels by hand), `mono_endo.mp4` (a part without
tools), two folders of `tools_more` (single frames with masks), `wild` (clips without tools). What is trained for one
set has not seen that set; `wild` is never trained on.

Phantoms have a family of instruments over two kinds of tissue each, with exact masks. They are rendered in three
dimensions and share nothing with the painted instruments of the training, so all of it is new to the network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from endoprior.data.images import decode_image, read_color, read_tool_mask
from endoprior.data.video_files import open_container
from endoprior.footage.border import find_outline
from endoprior.phantom import PhantomConfig, write_phantom

from .benchmark import TestFrame
from .composites import IGNORED, LabeledFrame

LONG_SIDE_PX = 420
"""Training frames are held at this size: parts of them become examples of 256 px."""
TOOL_FREE = range(97, 148)
"""Frames of `mono_endo` without a tool."""
ROUND_BORDER_LEVEL, MIN_ROUND_BORDER_PX = 25, 25
"""Largest level and least width of what is black around a round image."""
EYE_PX = 81
"""Size of the square around each pixel of a tool in which `cataract1k` tells what is none, px."""
WILD = ("colon_polyp", "colon_boxes", "fetoscopy", "broncho_phantom")
"""Clips without a tool."""
FAMILIES = ("gray_blue", "black", "white_plastic", "steel", "gold", "green", "blue", "mixed")
TISSUES = ("bowel", "pale", "fat", "purple", "liver", "warm", "smoke", "blood")
"""Of the phantoms."""
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


def sisvse_gastrectomy(root: Path) -> Iterator[Labeled]:
    """Robotic gastrectomy: gauze counts as a tool."""
    yield from _single_frames(root, "sisvse_gastrectomy")


def cataract1k(root: Path) -> Iterator[Labeled]:
    """An eye through a microscope. Its lid speculum is not labeled, so only what is around the tools is told."""
    for name, rgb_u8, label in _single_frames(root, "cataract1k"):
        told = cv2.dilate(label, np.ones((EYE_PX, EYE_PX), np.uint8)) > 0
        yield name, rgb_u8, np.where(told, label, IGNORED).astype(np.uint8)


def _single_frames(root: Path, name: str) -> Iterator[Labeled]:
    folder = root / "tools_more" / name
    for file in sorted((folder / "images").glob("*.jpg")):
        mask = read_tool_mask(folder / "masks" / f"{file.stem}.png")
        yield f"{name} {file.stem}", read_color(file), mask.astype(np.uint8)


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
                image = np.asarray(picture.to_ndarray(format="rgb24"), np.uint8)
                kernel = np.ones((MIN_ROUND_BORDER_PX, MIN_ROUND_BORDER_PX), np.uint8)
                dark = cv2.morphologyEx((image.max(-1) < ROUND_BORDER_LEVEL).astype(np.uint8), cv2.MORPH_OPEN, kernel)
                yield f"{path.stem} {i}", image, np.where(dark > 0, IGNORED, 0).astype(np.uint8)


SETS: dict[str, Callable[[Path], Iterator[Labeled]]] = {
    "bowel_lift": bowel_lift,
    "vocalfolds": vocalfolds,
    "mono_endo": mono_endo,
    "sisvse_gastrectomy": sisvse_gastrectomy,
    "cataract1k": cataract1k,
    "wild": wild,
}
TRAINED = ("bowel_lift", "vocalfolds", "mono_endo", "sisvse_gastrectomy", "cataract1k")
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
    ways = ((rgb_u8, cv2.INTER_AREA), (label, cv2.INTER_NEAREST))
    return LabeledFrame(*(np.asarray(cv2.resize(each, size, interpolation=way), np.uint8) for each, way in ways))


def phantom_sets() -> dict[str, tuple[PhantomConfig, ...]]:
    """The phantoms of each line of the table: two for each family; every tissue occurs twice."""
    plain = PhantomConfig(frames=6, width=320, height=256, side_views=False)
    return {
        f"phantom: {family}": tuple(
            replace(plain, seed=i, instruments=family, tissue=TISSUES[(i + shift) % len(TISSUES)]) for shift in (0, 3)
        )
        for i, family in enumerate(FAMILIES)
    }


def phantom_frames(folder: Path, phantoms: tuple[PhantomConfig, ...]) -> Iterator[TestFrame]:
    """The frames of some phantoms; written to `folder` once."""
    for cfg in phantoms:
        place = folder / f"{cfg.instruments}_{cfg.tissue}"
        if not place.exists():
            write_phantom(place, cfg)
        for i in range(cfg.frames):
            tools = read_tool_mask(place / "masks" / f"{i:06d}.png")
            whole = np.ones_like(tools)
            image = read_color(place / "images" / f"{i:06d}.png")
            yield TestFrame(f"{cfg.instruments} on {cfg.tissue} {i}", image, whole, tools, whole)
