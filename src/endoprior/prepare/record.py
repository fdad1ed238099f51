"""What `prepare` records about itself, so that the command can be repeated."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.shell import changed_options
from ..data.description import PrepareRecord
from .config import PrepareConfig
from .frame_geometry import FrameGeometry
from .frames import NETWORK
from .sam2 import SAM2

GRID_POINTS = 9  # points a side of the grid over a rectified frame; between them the rectification is nearly linear
METHODS = ("auto", "none", "sgbm", "shading", "still", "auto-own", "estimate", "own", "colmap", NETWORK, SAM2)
"""Values of --depth, --masks and --poses that are no paths."""
NETWORKS = (NETWORK, SAM2)  # methods that a folder of weights, or the name of a model, may follow after a colon


def record_of(
    video: Path, cfg: PrepareConfig, geometry: FrameGeometry, video_notes: Sequence[str] = ()
) -> PrepareRecord:
    """The record of a folder made from `video` with these options. Args: video_notes: what `check` repeats."""
    options = changed_options(cfg)
    for name in ("--depth", "--masks", "--poses"):
        if name in options:
            options[name] = (_absolute(options[name][0]),)
    return PrepareRecord(
        os.path.abspath(video), options, geometry.source_size, _source_px(geometry), tuple(video_notes)
    )


def names_path(value: str) -> bool:
    """Whether a value of --depth, --masks or --poses is a file or folder of the user."""
    return value not in METHODS and value.partition(":")[0] not in NETWORKS


def _absolute(value: str) -> str:
    """A method, or the absolute path of a file or folder."""
    method, colon, folder = value.partition(":")
    if method in NETWORKS and colon:  # a folder, or the name of a network on a server
        return f"{method}:{os.path.abspath(folder) if os.path.isdir(folder) else folder}"
    return os.path.abspath(value) if names_path(value) else value


def _source_px(geometry: FrameGeometry) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Where an even grid over the frame lies in the source image, px; a pixel is 1 wide and its center at a half."""
    x, y, width, height = geometry.cut
    count = 2 if geometry.maps[0] is None else GRID_POINTS
    columns, rows = np.meshgrid(np.linspace(x, x + width, count), np.linspace(y, y + height, count))
    grid: NDArray = np.stack([columns, rows], -1)
    if geometry.maps[0] is not None:
        # The maps have one entry for each pixel, at its center, and count centers from 0.
        at = (columns - 0.5).astype(np.float32), (rows - 0.5).astype(np.float32)
        maps = [cv2.remap(of, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for of in geometry.maps[0]]
        grid = np.stack(maps, -1) + 0.5
    return tuple(tuple(tuple(round(float(v), 2) for v in point) for point in row) for row in grid)
