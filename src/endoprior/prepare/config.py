"""What `endoprior prepare` can be told. The fields are its options."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..core.checks import InputError, check_range
from .calibration_files import Unit
from .layout import Layout
from .stereo import StereoConfig

Rectangle = tuple[int, int, int, int]
"""x, y, width, height, px of one eye's picture in the source."""


def parse_rectangle(text: str, option: str) -> Rectangle:
    """`x,y,width,height` in px.

    Raises:
        InputError: something else.
    """
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option}: expected x,y,width,height in px; got {text!r}. Try 0,0,640,500.") from None
    if min(x, y) < 0 or min(width, height) < 1:
        raise InputError(f"{option}: expected x, y >= 0 and width, height >= 1; got {text!r}. Try 0,0,640,500.")
    return x, y, width, height


@dataclass(frozen=True)
class PrepareConfig:
    """How a video becomes a sequence folder."""

    right: Path | None = None
    """Video or folder of the second eye, where each eye has its own."""
    calibration: Path | None = None
    """OpenCV calibration (.yaml, .json, .npz) or da Vinci .ini, of one or two eyes."""
    calibration_unit: Unit = "auto"
    """Unit of the calibration's T."""
    layout: Layout = "auto"
    """How the eyes share a frame."""
    swap_eyes: bool = False
    """The first eye of the video is the right one."""
    field_of_view_degrees: float = 70.0
    """Without a calibration: assumed angle across the picture's width, or across the round border."""

    start: float = 0.0
    """First moment, seconds."""
    end: float = math.inf
    """Last moment, seconds; not included."""
    frames_per_second: float = 0.0
    """Rate of the frames to write; 0 takes every picture of the source."""
    folder_rate: float = 25.0
    """Rate of a folder of pictures, 1/s."""
    max_frames: int = 500
    """Refuse to write more: a longer clip needs a part chosen, or a lower rate."""
    drop_out_of_body: bool = False
    """Leave out frames that do not look like the inside of a body."""

    crop: str | None = None
    """x,y,width,height in px of one eye's picture: nothing outside is written."""
    blank: tuple[str, ...] = ()
    """x,y,width,height rectangles to paint black and mask, for burned-in names."""
    border: Literal["auto", "keep"] = "auto"
    """`auto`: cut console strips and black bars, mask what lies outside a round border, blank burned-in labels."""
    max_width: int = 640
    """Shrink wider pictures to this width, px; 0 keeps the size."""

    depth: str = "auto"
    """`sgbm` (stereo), `shading` (one eye, relative), `depth-anything[:FOLDER]` (network, relative), a folder of depth
    files, or `none`; `auto` is sgbm for two eyes and shading for one."""
    depth_unit_mm: float = 0.0
    """mm per unit of the files of a depth folder; must be given with one, unless it is relative."""
    depth_relative: Literal["no", "depth", "disparity"] = "no"
    """The depth folder holds a network's relative depth, or relative disparity (near is large)."""
    working_distance_mm: float = 70.0
    """Median distance that relative depth is scaled to."""
    stereo: StereoConfig = field(default_factory=StereoConfig)

    masks: str = "auto"
    """`auto` (found by color and depth), `none`, or a folder of masks."""
    mask_tool_value: Literal["auto", "high", "low"] = "auto"
    """Which value marks tools in the mask folder."""

    poses: str = "auto"
    """`still`, `estimate` (from depth and what stands still), or a file: .npy (T, 4, 4) camera-to-world in mm, or
    poses_bounds.npy. `auto` estimates if the camera moves."""
    stir: Path | None = None
    """Folder of the STIR clip (`left/seqNN`) that VIDEO belongs to: its tattooed points become `truth/tracks.npz`."""
    keep_right: bool = False
    """Also write the second eye's pictures to `right/`."""

    def __post_init__(self) -> None:
        if self.stir is not None and self.depth == "none":
            raise ValueError("stir needs depth, which --depth none leaves out")
        check_range("field_of_view_degrees", self.field_of_view_degrees, 10, 170)
        check_range("start", self.start, 0, 1e9)
        if not self.end > self.start:
            raise ValueError(f"end must come after start; got {self.end:g} and {self.start:g}")
        check_range("frames_per_second", self.frames_per_second, 0, 1000)
        check_range("folder_rate", self.folder_rate, 0.01, 1000)
        check_range("max_frames", self.max_frames, 2, 1_000_000)
        check_range("max_width", self.max_width, 0, 16384)
        check_range("depth_unit_mm", self.depth_unit_mm, 0, 1e6)
        check_range("working_distance_mm", self.working_distance_mm, 1, 1000)
