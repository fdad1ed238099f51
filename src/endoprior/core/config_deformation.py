"""How Gaussians move: the part of the config that says how a scene deforms. See `config.py`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

from .checks import check_range
from .ranges import Checked, Count, Range

FRAMES_PER_SPAN = 2.0
"""Frames between two knots of the splines of displacement. With 1.8 held-out frames follow worse where tissue rests."""
CHANGE_SPANS = 0.37
"""Spans of the splines of rotation, scale and color, which change more slowly, for each span of displacement."""
DEGREE = 3  # of the splines: one with K spans between knots has K + DEGREE functions
MIN_BASES, MAX_BASES = DEGREE + 1, 1000
CELLS_PER_FRAME = 0.4
"""Cells of a HexPlane along time for each frame, where `fit_to_clip` is on: published are 0.79 and 0.32. With 0.5 every
second frame can lie on a node of the planes, which only its neighbors pin where it is held out (docs/log.md)."""


@dataclass(frozen=True)
class HexPlaneConfig(Checked):
    """Space-time feature planes and the heads that read offsets from them."""

    resolution: ClassVar[tuple[int, int, int]] = (64, 64, 64)
    """Cells along x, y, z at the scale 1."""
    time_resolution: Annotated[int, Range(2, 100_000)] = 100
    """Cells along time, at every scale. More follow faster motion, with more memory."""
    channels: Annotated[int, Range(1, 256)] = 64
    """Feature channels of each plane. More hold more detail of motion, with more memory and time."""
    multires: Annotated[tuple[int, ...], Range(1, 1000)] = (1, 2, 4, 8)
    """Spatial scales, as multiples of 64 cells along each axis; features of all are concatenated. Larger ones hold
    finer detail, with memory that grows with their square."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("number of multires", len(self.multires), 1, 16)
        x, y, z = self.resolution
        cells = sum(m * (m * (x * y + x * z + y * z) + (x + y + z) * self.time_resolution) for m in self.multires)
        check_range("numbers in all planes", cells * self.channels, 1, 1e9)  # training holds them four times

    def fitted(self, num_frames: int) -> HexPlaneConfig:
        """This config with `CELLS_PER_FRAME` cells along time. The times 0 to 1 lie in the second half of a plane."""
        return replace(self, time_resolution=max(2, round(2 * CELLS_PER_FRAME * num_frames) + 1))


@dataclass(frozen=True)
class BasisConfig(Checked):
    """Coefficients of each Gaussian for cubic B-splines over time: a linear map, no network."""

    num_bases: Annotated[int, Range(0, MAX_BASES)] = 0
    """Spline functions of the displacement; rotation, scale and color have about 0.4 as many. More follow faster
    motion, and frames that were not trained on less well; 0 takes one for every 2 frames, and 3."""
    num_frames: Count = 0
    """Frames with a displacement of their own beside the spline, which optical flow gives; 0 takes all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("num_bases", self.num_bases or MIN_BASES, MIN_BASES, MAX_BASES)

    @property
    def num_change_bases(self) -> int:
        """Spline functions of rotation, scale and color."""
        return max(round(CHANGE_SPANS * (self.num_bases - DEGREE)), 1) + DEGREE

    def fitted(self, num_frames: int) -> BasisConfig:
        """This config with the numbers for `num_frames`, where none is chosen yet."""
        chosen = min(max(round(num_frames / FRAMES_PER_SPAN), 1) + DEGREE, MAX_BASES)
        return BasisConfig(self.num_bases or chosen, self.num_frames or num_frames)


@dataclass(frozen=True)
class DeformationConfig(Checked):
    """How canonical Gaussians move."""

    kind: Literal["hexplane", "basis"] = "basis"
    """`basis`: splines over time per Gaussian; `hexplane`: the paper's field."""
    hexplane: HexPlaneConfig = field(default_factory=HexPlaneConfig)
    basis: BasisConfig = field(default_factory=BasisConfig)
    deform_shape: bool = True
    """Let scales and rotations change with time; off, Gaussians only move."""
    deform_opacity: bool = False
    """Let opacity change with time, as the released code does; EndoGaussian renders the canonical one."""
    max_scale_change: Annotated[float, Range(0, 1e6)] = 2.0
    """Over time a scale becomes at most this many times larger or smaller, and no canonical one exceeds about 1.6 % of
    its distance to the camera. Higher blurs what is seen from aside; up to 1 sets no limit."""
