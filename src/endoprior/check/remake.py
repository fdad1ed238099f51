"""The `prepare` command that makes a sequence again with another option: from its video, or from its own frames."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.config import DataConfig
from ..core.shell import Options, command_of
from ..core.types import Camera
from ..data import FrameSequence
from ..data.camera_matrix import MATRIX_FILE
from ..data.files import entries
from ..data.load import find_format
from ..data.prepare_record import SURROGATES, PrepareRecord, read_record

FROM_FRAMES = ("endonerf", "no_depth", "plain")
"""Layouts whose files `prepare` reads with their meaning unchanged."""
NERFSTUDIO, TRANSFORMS = "nerfstudio", "transforms.json"
"""The layout from whose images and lens `prepare` makes depth, and a camera path of its own."""
MOST_FRAMES = 10_000
"""Number of frames that `prepare` accepts without `--max-frames`."""
VIEWS = (10.0, 170.0)
"""Fields of view that `prepare` accepts, degrees."""


@dataclass(frozen=True)
class Remake:
    """A `prepare` command for the sequence."""

    source: Path
    """Video, or folder of images."""
    out: Path
    """A folder that does not exist yet."""
    options: Options

    def command(self, changes: Mapping[str, tuple[str, ...] | None]) -> str:
        """The command with other options, in backticks; None removes an option."""
        options = {name: words for name, words in (self.options | changes).items() if words is not None}
        return f"`{command_of('prepare', (self.source, self.out), options)}`"


@dataclass(frozen=True)
class Remakes:
    """What the sequence can be made from again."""

    record: PrepareRecord | None
    """Of the `prepare` that made the folder."""
    from_video: Remake | None
    """Repeats that `prepare`; None if the video is not known or not there any more, or its path is no text."""
    from_frames: Remake | None
    """Keeps frames, depth, masks and poses as they are, as far as the layout has them in our units; None for layouts
    that `prepare` would misread."""

    @property
    def best(self) -> Remake | None:
        """From the video where possible: it has more pixels than the frames."""
        return self.from_video or self.from_frames

    def crop(self, left: float, top: float, right: float, bottom: float, size: Sequence[int]) -> str | None:
        """The command that keeps only a part of the frame; None if the sequence cannot be made again.

        Args:
            left, top, right, bottom: the part, as shares of the frame's width and height.
            size: (width, height) of the stored frames, px.
        """
        if self.from_video and self.record:
            rectangle = self.record.crop(left, top, right, bottom)
        else:
            x0, y0, x1, y1 = (round(v) for v in np.array((left, top, right, bottom)) * np.tile(size, 2))
            rectangle = (x0, y0, x1 - x0, y1 - y0)
        return self.best and self.best.command({"--crop": (",".join(map(str, rectangle)),)})


def find_remakes(sequence: FrameSequence, described: Mapping[str, Any], cfg: DataConfig) -> Remakes:
    """Look for the video and the frames of a sequence.

    Args:
        described: content of `sequence.json`.
        cfg: options with which the sequence was opened.
    Raises:
        InputError: `prepare.json` is damaged.
    """
    path = sequence.path
    record, out = read_record(path), _new_folder(path)
    from_video = from_frames = None
    if record and SURROGATES not in record.categories and Path(record.video).exists():
        from_video = Remake(Path(record.video), out, record.options)
    layout = find_format(path, cfg)
    if layout in FROM_FRAMES:
        options = _options_of_frames(path, sequence, described, cfg)
        from_frames = Remake(path / "images", out, options)
    elif layout == NERFSTUDIO and (path / "images").is_dir():
        options = {"--border": ("keep",), "--max-width": ("0",), "--layout": ("mono",)}
        options["--calibration"] = (str(path / TRANSFORMS),)
        if (path / "masks").is_dir():
            options["--masks"] = (str(path / "masks"),)
        from_frames = Remake(path / "images", out, options)
    return Remakes(record, from_video, from_frames)


def _options_of_frames(path: Path, sequence: FrameSequence, described: Mapping[str, Any], cfg: DataConfig) -> Options:
    """Options with which `prepare` leaves frames, camera, masks, depth and poses as they are."""
    options: Options = {"--border": ("keep",), "--max-width": ("0",)}
    if (count := len(entries(path / "images"))) > MOST_FRAMES:
        options["--max-frames"] = (str(count),)
    if sequence.frames_per_second:
        options["--folder-rate"] = (f"{sequence.frames_per_second * (cfg.stride or 1):g}",)
    if {"fx", "cx", "cy"} <= described.keys():
        options["--calibration"] = (str(path / "sequence.json"),)
    elif (path / MATRIX_FILE).is_file() and "fx" not in described:
        options["--calibration"] = (str(path / MATRIX_FILE),)
    else:
        options["--field-of-view-degrees"] = (f"{np.clip(field_of_view(sequence.camera(0)), *VIEWS):.6g}",)
    if (path / "right").is_dir() and "baseline_mm" in described and "--calibration" in options:
        options |= {"--right": (str(path / "right"),), "--keep-right": ()}
    else:
        options["--layout"] = ("mono",)
    masks = path / ("gt_masks" if cfg.use_gt_masks else "masks")
    if masks.is_dir():
        tool_value = "high" if described.get("mask_tool_value", 255) == 255 else "low"
        options |= {"--masks": (str(masks),), "--mask-tool-value": (tool_value,)}
    if (path / "depth").is_dir():
        options["--depth"] = (str(path / "depth"),)
        if sequence.depth_is_relative:
            options["--depth-relative"] = ("depth",)
        else:
            unit = cfg.depth_unit_mm or described.get("depth_scale") or 1.0
            options["--depth-unit-mm"] = (f"{unit:g}",)
    if (path / "poses_bounds.npy").is_file():
        options["--poses"] = (str(path / "poses_bounds.npy"),)
    return options


def field_of_view(camera: Camera) -> float:
    """Angle across the width of the image, degrees."""
    return float(2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)))


def swapped(remakes: Remakes) -> str | None:
    """The command that exchanges the cameras and measures depth and masks again; None if they cannot be."""
    if video := remakes.from_video:
        return video.command({"--swap-eyes": None if "--swap-eyes" in video.options else ()})
    frames = remakes.from_frames
    if frames is None or "--right" not in frames.options:
        return None
    (right,) = frames.options["--right"]
    measured = dict.fromkeys(("--masks", "--mask-tool-value", "--depth", "--depth-unit-mm", "--depth-relative"))
    return replace(frames, source=Path(right)).command(measured | {"--right": (str(frames.source),)})


def _new_folder(path: Path) -> Path:
    """The first of `DATA_2`, `DATA_3`, ... that does not exist."""
    named = path if path.name not in ("", "..") else Path(os.path.abspath(path))
    numbered = (named.with_name(f"{named.name}_{number}") for number in itertools.count(2))
    return next(out for out in numbered if not out.exists())
