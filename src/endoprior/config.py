"""Every number of the method, one frozen dataclass per concern: schema, defaults, command line and manual.

Defaults are the paper's; where it is silent, EndoGaussian's. `presets.py` says how the other presets differ. Anyone may
import this module; it imports nothing of ours but `checks`. "mm" below means the unit of the sequence's depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from .checks import InputError, check_range


@dataclass(frozen=True)
class DataConfig:
    """How frames are read."""

    use_gt_masks: bool = False
    """Read `gt_masks/` (tools only) in place of `masks/` (tools and failed stereo)."""
    depth_clip_low_percentile: float = 3.0
    """Valid depths of a frame are clipped from below at this percentile of themselves."""
    depth_clip_high_percentile: float = 99.8
    """... and from above at this one."""
    lift_missing_depth: bool = False
    """EndoGaussian's habit: missing depth becomes the near clip value and counts as measured."""
    shrink: int = 1
    """Read frames at this fraction of their width and height: 2 averages blocks of 2 x 2 pixels."""
    first_frames: int = 0
    """Read only so many frames from the start of the sequence; 0 reads all."""
    format: Literal["auto", "scared", "c3vd", "stir", "stereomis", "hamlyn", "endonerf", "plain"] = "auto"
    """Layout of the folder (docs/datasets.md); `auto` recognizes it."""
    stride: int = 0
    """Keep every n-th frame of the folder; 0 takes what is published for the dataset."""
    depth_unit_mm: float = 0.0
    """mm per unit of the stored depth; 0 takes what the folder or its format says."""

    def __post_init__(self) -> None:
        check_range("stride", self.stride, 0, 10_000)
        check_range("depth_unit_mm", self.depth_unit_mm, 0, 1e6)
        check_range("shrink", self.shrink, 1, 64)
        check_range("first_frames", self.first_frames, 0, 10_000_000)
        check_range("depth_clip_low_percentile", self.depth_clip_low_percentile, 0, 100)
        check_range("depth_clip_high_percentile", self.depth_clip_high_percentile, self.depth_clip_low_percentile, 100)


@dataclass(frozen=True)
class SpecularConfig:
    """Specular likelihood L^sp, Eq. (2)."""

    value_threshold: float = 0.85
    """tau_v: brightness above which a pale pixel is a highlight."""
    saturation_threshold: float = 0.35
    """tau_s: saturation below which a bright pixel is pale."""
    value_temperature: float = 0.04
    """gamma_v > 0."""
    saturation_temperature: float = 0.08
    """gamma_s > 0."""
    clip_threshold: float = 0.92
    """tau_o: two or more channels above it make the likelihood 1."""

    def __post_init__(self) -> None:
        check_range("value_temperature", self.value_temperature, 1e-30, 1e30)
        check_range("saturation_temperature", self.saturation_temperature, 1e-30, 1e30)


@dataclass(frozen=True)
class SalienceConfig:
    """Structural salience E, Eqs. (3)-(5)."""

    percentile: float = 99.0
    """p: the edge magnitude at this percentile of tissue pixels maps to 1."""
    border: Literal["reflect", "zero"] = "reflect"
    """How the Sobel filter continues the image; `zero` makes every bright border an edge (released training code)."""

    def __post_init__(self) -> None:
        check_range("percentile", self.percentile, 0, 100)


@dataclass(frozen=True)
class PriorConfig:
    """Joint texture prior rho, Eq. (1)."""

    specular: SpecularConfig = field(default_factory=SpecularConfig)
    salience: SalienceConfig = field(default_factory=SalienceConfig)


@dataclass(frozen=True)
class InitConfig:
    """Where Gaussians start: Eq. (6) and EndoGaussian's pool."""

    sampler: Literal["prior", "uniform", "pool"] = "prior"
    """`prior`: Eq. (6), equal share per frame; `uniform`: the same shares, no prior; `pool`: EndoGaussian's."""
    budget: int = 20_000
    """Pixels drawn over all training frames."""
    uniform_fraction: float = 0.45
    """eta_app: share of the probability spread evenly over the eroded tissue mask."""
    erosion_px: int = 9
    """k: side of the elliptical element that erodes the tissue mask."""
    adaptive_specular: bool = False
    """Raise tau_v to the 97th percentile of brightness in the eroded mask (released code)."""
    salience_on_eroded_mask: bool = False
    """Take the percentile of Eq. (5) over the eroded mask (released code)."""
    pool_fraction: float = 0.01
    """Share of tissue pixels that each frame gives to EndoGaussian's pool."""
    cleanup: bool = False
    """Voxel merge and statistical outlier removal after sampling (released code)."""
    voxel_divisions: int = 400
    """Voxels along the longest side of the point cloud's box."""
    outlier_neighbors: int = 20
    """Neighbors whose mean distance is judged."""
    outlier_std: float = 1.5
    """Points farther than mean + this many standard deviations are dropped."""
    pixel_offset: Literal["exact", "legacy"] = "exact"
    """`legacy` back-projects integer pixels, half a pixel up and left of where they are drawn (EndoGaussian)."""
    variance_factor: float = 1.0
    """Initial variance = this times the mean squared distance to the 3 nearest points (released code: 0.4)."""
    opacity: float = 0.1
    """Initial opacity."""
    motion: Literal["rest", "flow"] = "rest"
    """Start of the temporal coefficients (`kind` basis): at rest, or along tracks of optical flow and depth."""

    def __post_init__(self) -> None:
        check_range("budget", self.budget, 1, 10_000_000)
        check_range("uniform_fraction", self.uniform_fraction, 0, 1)
        check_range("pool_fraction", self.pool_fraction, 0, 1)
        check_range("opacity", self.opacity, 1e-4, 0.9999)


@dataclass(frozen=True)
class HexPlaneConfig:
    """Space-time feature planes and the heads that read offsets from them."""

    resolution: tuple[int, int, int] = (64, 64, 64)
    """Base cells along x, y, z."""
    time_resolution: int = 100
    """Cells along time, at every scale."""
    channels: int = 64
    """Feature channels of each plane."""
    multires: tuple[int, ...] = (1, 2, 4, 8)
    """Spatial scale multipliers; features of all scales are concatenated."""
    width: int = 32
    """Hidden width of the trunk and the heads."""
    learn_box: bool = True
    """Train the bounding box together with the planes, as EndoGaussian does without saying so."""
    time_map: Literal["raw", "full"] = "raw"
    """`raw` feeds t in [0, 1) into [-1, 1] and so uses half of each time plane; `full` maps it to the whole."""
    bias_init: Literal["default", "zero"] = "default"
    """Biases of trunk and heads: PyTorch's default, or zero (released code)."""


@dataclass(frozen=True)
class BasisConfig:
    """One coefficient per Gaussian, temporal basis function and channel: a linear map, no network."""

    num_bases: int = 31
    """B: Gaussian bumps over time, centered evenly on [0, 1]; 0 takes one for every `frames_per_basis` frames."""
    frames_per_basis: float = 2.2
    """Frames of the sequence for each bump, where `num_bases` is 0; there are never fewer than 4 bumps."""
    relative_width: float = 1.2
    """Standard deviation of a bump in units of 1 / B."""
    deform_color: bool = True
    """Also let the view-independent color change with time."""

    def __post_init__(self) -> None:
        if self.num_bases != 0:
            check_range("num_bases", self.num_bases, 2, 1000)
        check_range("frames_per_basis", self.frames_per_basis, 0.5, 1000)

    def fitted(self, num_frames: int) -> BasisConfig:
        """The same with a number of bumps, chosen for a sequence of `num_frames` if there is none yet."""
        chosen = min(max(round(num_frames / self.frames_per_basis), 4), 1000)
        return self if self.num_bases else replace(self, num_bases=chosen)


@dataclass(frozen=True)
class DeformationConfig:
    """How canonical Gaussians move."""

    kind: Literal["hexplane", "basis"] = "hexplane"
    """`hexplane`: the paper's field; `basis`: temporal coefficients per Gaussian."""
    hexplane: HexPlaneConfig = field(default_factory=HexPlaneConfig)
    basis: BasisConfig = field(default_factory=BasisConfig)
    deform_scales: bool = True
    """Let scales change with time."""
    deform_quats: bool = True
    """Let rotations change with time."""
    deform_opacity: bool = False
    """Draw the deformed opacity (released code); EndoGaussian computes it and draws the canonical one."""


@dataclass(frozen=True)
class RenderConfig:
    """How splats are drawn."""

    backend: Literal["cpu", "reference"] = "cpu"
    """`cpu`: Numba kernels; `reference`: dense plain torch, for small scenes."""
    depth_grad_to_means: bool = False
    """Let the gradient of rendered depth reach the composited z; EndoGaussian's rasteriser drops it."""


@dataclass(frozen=True)
class LossConfig:
    """Supervised terms of Eq. (12)."""

    depth_weight: float = 1.0
    """lambda_depth, of the L1 on inverse depth (1 / mm)."""
    tv_weight: float = 0.03
    """lambda_tv, of the total variation of color and inverse depth over the whole frame."""
    depth_mode: Literal["accumulated", "expected"] = "accumulated"
    """Depth that is compared: sum of weight * z, or that divided by alpha."""
    min_depth_pixels: int = 10
    """A frame with fewer measured tissue depths gets no depth loss."""


@dataclass(frozen=True)
class TemporalConfig:
    """Texture-aware temporal consistency, Eqs. (9)-(11)."""

    weight: float = 1e-6
    """lambda_local; 0 switches the term off."""
    start_iteration: int = 1000
    """First fine iteration with the term."""
    displacement_weight: float = 1.0
    """lambda_disp."""
    distance_weight: float = 0.2
    """lambda_dist."""
    num_neighbors: int = 8
    """K."""
    huber_delta: float = 0.01
    """delta, mm."""
    huber_scale: Literal["literal", "released"] = "literal"
    """`released` divides Huber's penalty by delta (smooth L1)."""
    motion_threshold: float = 0.45
    """tau_m."""
    motion_temperature: float = 0.08
    """gamma_m."""
    adaptive_motion_weight: bool = False
    """Relax tau_m and gamma_m until `min_effective` Gaussians count (released code)."""
    min_effective: int = 256
    """Effective sample size sought by the relaxation."""
    pair_weights: bool = True
    """False gives every pair weight 1 (the paper's ablation)."""
    min_valid: int = 20
    """n_min: projections a Gaussian needs before it takes part."""
    valid_at_both: bool = True
    """Demand a projection onto tissue at both times; False: being drawn at time t is enough (released code)."""
    max_points: int = 0
    """Gaussians drawn by weight for each step; 0 takes all that are eligible."""
    min_points: int = 128
    """With fewer eligible Gaussians the step goes without the term."""
    gradient: Literal["both", "current"] = "both"
    """Which end of the displacement is trained: both, or only time t (released code)."""


@dataclass(frozen=True)
class DensityConfig:
    """Growth and pruning, Eqs. (7)-(8) and the rule after them."""

    start_iteration: int = 500
    """Events happen after this iteration of a stage ..."""
    every: int = 100
    """... at multiples of this one ..."""
    stop_iteration: int = 15_000
    """... before this one, and never at the last fine iteration."""
    grow_threshold: float = 2e-4
    """Mean screen-space gradient that makes a Gaussian grow, NDC units."""
    min_densify_weight: float = 0.35
    """lambda_min^den; 1 gives plain 3DGS growth."""
    clone_extent: float = 0.01
    """Gaussians with a scale up to this share of the scene extent are cloned, larger ones split."""
    extent_mode: Literal["camera", "scene"] = "camera"
    """`camera`: radius of the camera path (0 for a still camera: split only); `scene`: radius of the points."""
    split_shrink: float = 1.6
    """Children of a split have the parent's scale divided by this."""
    prune_opacity: float = 0.005
    """Gaussians below this opacity go."""
    prune_max_scale_mm: float = 0.0
    """Gaussians with a larger scale go; 0 switches the rule off (released code: 40)."""
    prior_prune: bool = True
    """Also remove what the prior distrusts: n >= n_min, score < tau_prior, mean opacity < tau_alpha."""
    min_valid: int = 20
    """n_min."""
    prior_threshold: float = 0.2
    """tau_prior."""
    prior_opacity: float = 0.0075
    """tau_alpha."""
    score_mode: Literal["events", "every"] = "every"
    """When s is sampled: at each iteration, or only from the frame of a density event (released code)."""
    unobserved_score: float = 0.0
    """Score of a Gaussian that was never seen: the paper's 0 / epsilon, or 1 (released code)."""
    max_gaussians: int = 200_000
    """Growth stops at this count: a guard, not part of the method."""

    def __post_init__(self) -> None:
        check_range("min_densify_weight", self.min_densify_weight, 0, 1)
        check_range("unobserved_score", self.unobserved_score, 0, 1)
        check_range("every", self.every, 1, 1_000_000)


@dataclass(frozen=True)
class OptimConfig:
    """Adam, one learning rate per group. Rates marked * are multiplied by the spatial scale of the sequence."""

    means_lr: float = 1.6e-4
    """* Initial rate of the centers."""
    means_lr_final: float = 1.6e-6
    """* Rate at `decay_iterations`; log-linear in between."""
    network_lr: float = 1.6e-4
    """* Initial rate of trunk and heads."""
    network_lr_final: float = 1.6e-6
    planes_lr: float = 1.6e-3
    """* Initial rate of planes and box."""
    planes_lr_final: float = 1.6e-5
    basis_means_lr: float = 2e-2
    """Initial rate of the temporal coefficients of the centers, mm."""
    basis_quats_lr: float = 2e-3
    basis_log_scales_lr: float = 5e-3
    basis_opacity_lr: float = 2e-2
    basis_color_lr: float = 2.5e-3
    basis_decay: float = 0.1
    """Share of these four rates left at `decay_iterations`; log-linear."""
    decay_iterations: int = 4000
    """Iterations, counted in each stage, over which the rates above decay."""
    sh_dc_lr: float = 2.5e-3
    sh_rest_lr: float = 1.25e-4
    opacity_lr: float = 5e-2
    scales_lr: float = 5e-3
    quats_lr: float = 1e-3
    epsilon: float = 1e-15
    """Adam's epsilon."""
    still_camera_scale: float = 10.0
    """Spatial scale of a sequence whose camera stands still."""


@dataclass(frozen=True)
class ScheduleConfig:
    """What happens when."""

    coarse_iterations: int = 1000
    """Stage one: the first training frame alone, no deformation."""
    fine_iterations: int = 3000
    """Stage two: a random training frame each time, deformed."""
    sh_degree: int = 3
    """Highest degree of the color's spherical harmonics."""
    half_resolution_iterations: int = 0
    """Fine iterations, from the first on, that see frames of half the width and height."""
    sh_every: int = 500
    """The degree in use rises by one each time this many iterations of a stage have passed."""

    def __post_init__(self) -> None:
        check_range("sh_degree", self.sh_degree, 0, 3)
        check_range("fine_iterations", self.fine_iterations, 1, 10_000_000)
        check_range("coarse_iterations", self.coarse_iterations, 0, 10_000_000)


@dataclass(frozen=True)
class Config:
    """All of it. Equal configs, data and machine give equal bits on a CPU."""

    seed: int = 0
    """Seed of sampling, initial weights, frame order and splits."""
    data: DataConfig = field(default_factory=DataConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    init: InitConfig = field(default_factory=InitConfig)
    deformation: DeformationConfig = field(default_factory=DeformationConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    temporal: TemporalConfig = field(default_factory=TemporalConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def __post_init__(self) -> None:
        if self.init.motion == "flow" and self.deformation.kind != "basis":
            raise InputError(
                f"init.motion: expected rest with deformation.kind {self.deformation.kind}; got flow, which only the "
                "temporal basis can start from. Set --init.motion rest."
            )

    def fitted(self, num_frames: int) -> Config:
        """The config with what it leaves to the length of the sequence filled in."""
        return replace(self, deformation=replace(self.deformation, basis=self.deformation.basis.fitted(num_frames)))
