"""How Gaussians move: the part of the config that says how a scene deforms. See `config.py`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from .checks import check_range
from .ranges import Checked, Range


@dataclass(frozen=True)
class HexPlaneConfig(Checked):
    """Space-time feature planes and the heads that read offsets from them."""

    resolution: Annotated[tuple[int, int, int], Range(2, 10_000)] = (64, 64, 64)
    """Base cells along x, y, z."""
    time_resolution: Annotated[int, Range(2, 100_000)] = 100
    """Cells along time, at every scale."""
    channels: Annotated[int, Range(1, 256)] = 64
    """Feature channels of each plane."""
    multires: Annotated[tuple[int, ...], Range(1, 1000)] = (1, 2, 4, 8)
    """Spatial scale multipliers; features of all scales are concatenated."""
    width: Annotated[int, Range(1, 4096)] = 32
    """Hidden width of the trunk and the heads."""
    learn_box: bool = True
    """Train the bounding box together with the planes, as EndoGaussian does without saying so."""
    time_map: Literal["raw", "full"] = "raw"
    """`raw` feeds t in [0, 1) into [-1, 1] and so uses half of each time plane; `full` maps it to the whole."""
    bias_init: Literal["default", "zero"] = "default"
    """Biases of trunk and heads: PyTorch's default, or zero (released code)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("number of multires", len(self.multires), 1, 16)
        x, y, z = self.resolution
        cells = sum(m * (m * (x * y + x * z + y * z) + (x + y + z) * self.time_resolution) for m in self.multires)
        check_range("numbers in all planes", cells * self.channels, 1, 1e9)  # training holds them four times


@dataclass(frozen=True)
class BasisConfig(Checked):
    """One coefficient per Gaussian, temporal basis function and channel: a linear map, no network."""

    num_bases: Annotated[int, Range(0, 1000)] = 31
    """B: basis functions over time, centered evenly on [0, 1]; 0 takes one for every `frames_per_basis` frames."""
    frames_per_basis: Annotated[float, Range(0.5, 1000)] = 1.8
    """Frames of the sequence for each basis function, where `num_bases` is 0; there are never fewer than 4."""
    relative_width: Annotated[float, Range(1e-3, 1e3)] = 1.5
    """Standard deviation of a basis function in units of 1 / B."""
    deform_color: bool = True
    """Also let the view-independent color change with time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("num_bases", self.num_bases or 2, 2, 1000)

    def fitted(self, num_frames: int) -> BasisConfig:
        """This config with a number of basis functions, chosen for `num_frames` if there is none yet."""
        chosen = min(max(round(num_frames / self.frames_per_basis), 4), 1000)
        return self if self.num_bases else replace(self, num_bases=chosen)


@dataclass(frozen=True)
class DeformationConfig(Checked):
    """How canonical Gaussians move."""

    kind: Literal["hexplane", "basis"] = "hexplane"
    """`hexplane`: the paper's field; `basis`: temporal coefficients per Gaussian."""
    hexplane: HexPlaneConfig = field(default_factory=HexPlaneConfig)
    basis: BasisConfig = field(default_factory=BasisConfig)
    deform_scales: bool = True
    """Let scales change with time."""
    deform_quats: bool = True
    """Let rotations change with time."""
    max_scale_change: Annotated[float, Range(0, 1e6)] = 0.0
    """Over time a scale becomes at most this many times larger or smaller; up to 1 sets no limit."""
    deform_opacity: bool = False
    """Render the deformed opacity (released code); EndoGaussian computes it and renders the canonical one."""
