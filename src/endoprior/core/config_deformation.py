"""How Gaussians move: the part of the config that says how a scene deforms. See `config.py`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

from .checks import check_range
from .ranges import Checked, Range

FRAMES_PER_BASIS = 1.8
"""Frames of the sequence for each basis function; 1.5 to 3.5 are best, more functions follow held-out frames worse."""
FEWEST_BASES, MOST_BASES = 4, 1000
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
    """One coefficient per Gaussian, temporal basis function and channel: a linear map, no network."""

    num_bases: Annotated[int, Range(0, MOST_BASES)] = 0
    """Basis functions over time. More follow faster motion, and frames that were not trained on less well; 0 takes one
    for every 1.8 frames, at least 4."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("num_bases", self.num_bases or 2, 2, MOST_BASES)

    def fitted(self, num_frames: int) -> BasisConfig:
        """This config with a number of basis functions, chosen for `num_frames` if there is none yet."""
        chosen = min(max(round(num_frames / FRAMES_PER_BASIS), FEWEST_BASES), MOST_BASES)
        return self if self.num_bases else replace(self, num_bases=chosen)


@dataclass(frozen=True)
class DeformationConfig(Checked):
    """How canonical Gaussians move."""

    kind: Literal["hexplane", "basis"] = "basis"
    """`basis`: temporal coefficients per Gaussian; `hexplane`: the paper's field."""
    hexplane: HexPlaneConfig = field(default_factory=HexPlaneConfig)
    basis: BasisConfig = field(default_factory=BasisConfig)
    deform_shape: bool = True
    """Let scales and rotations change with time; off, Gaussians only move."""
    deform_opacity: bool = False
    """Let opacity change with time, as the released code does; EndoGaussian renders the canonical one."""
    max_scale_change: Annotated[float, Range(0, 1e6)] = 2.0
    """Over time a scale becomes at most this many times larger or smaller, and no canonical one exceeds about 1.6 % of
    its distance to the camera. Higher blurs what is seen from aside; up to 1 sets no limit."""
