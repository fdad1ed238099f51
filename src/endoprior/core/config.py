"""Every number of the method, one frozen dataclass per concern: schema, defaults, command line and manual.

Those of the deformation are in `config_deformation.py`.

Defaults are the paper's; where it is silent, EndoGaussian's. `presets.py` says how the other presets differ. "mm" below
means the unit of the sequence's depth.

The type of a field states its range. Values beyond it exhaust memory, loop for ever or give NaN, and config files may
come from anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from .checks import InputError, check_range, read_ranges
from .config_deformation import DeformationConfig
from .config_io import from_dict, override, to_dict
from .ranges import Checked, Count, DecayedRate, Percent, Positive, Range, Rate, Share, Threshold, Weight

OWN = "endoprior"
"""Our own method."""
Backend = Literal["reference", "numba", "triton", "gsplat"]
"""What renders: see `render`."""


@dataclass(frozen=True)
class DataConfig(Checked):
    """How frames are read."""

    use_gt_masks: bool = False
    """Read `gt_masks/` (tools only) in place of `masks/` (tools and failed stereo)."""
    depth_clip_low_percentile: Percent = 3.0
    """Valid depths of a frame are clipped from below at this percentile of themselves."""
    depth_clip_high_percentile: Percent = 99.8
    """... and from above at this one."""
    lift_missing_depth: bool = False
    """As EndoGaussian does: missing depth becomes the near clip value and counts as measured."""
    shrink: Annotated[int, Range(1, 64)] = 1
    """Divide width and height by this. 2 averages blocks of 2 x 2 pixels."""
    first_frames: Count = 0
    """Read only the first frames; 0 reads all."""
    skip_frames: str = ""
    """Frames to leave out, such as `0-9,15`. Numbers of `endoprior check`, after `stride` and `first_frames`."""
    window: str = ""
    """The frames to train on, such as `60-129`: a window of a long sequence, whose held-out frames stay held out."""
    format: str = "auto"
    """Layout of the folder: a name in docs/datasets.md, such as `endonerf`; `auto` recognizes it."""
    stride: Annotated[int, Range(0, 10_000)] = 0
    """Keep every n-th frame of the folder; 0 takes what is published for the dataset."""
    depth_unit_mm: Weight = 0.0
    """mm per unit of the stored depth; 0 takes what the folder or its format says."""
    test_phase: Annotated[int, Range(0, 7)] = 0
    """Which frame of every eight is held out: frame i if (i - 1) mod 8 is this. 0 is the published split."""
    eyes: Literal["left", "both"] = "left"
    """Eyes whose pictures are trained on, in turn at random; `both` needs the right ones (docs/scores.md)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        read_ranges("skip_frames", self.skip_frames)
        read_ranges("window", self.window)
        check_range("depth_clip_high_percentile", self.depth_clip_high_percentile, self.depth_clip_low_percentile, 100)


@dataclass(frozen=True)
class SpecularConfig(Checked):
    """Specular likelihood L^sp, Eq. (2)."""

    value_threshold: Threshold = 0.85
    """tau_v: brightness above which a pale pixel is a highlight."""
    saturation_threshold: Threshold = 0.35
    """tau_s: saturation below which a bright pixel is pale."""
    value_temperature: Annotated[float, Range(1e-30, 1e30)] = 0.04
    """gamma_v > 0."""
    saturation_temperature: Annotated[float, Range(1e-30, 1e30)] = 0.08
    """gamma_s > 0."""
    clip_threshold: Threshold = 0.92
    """tau_o: two or more channels above it make the likelihood 1."""


@dataclass(frozen=True)
class SalienceConfig(Checked):
    """Structural salience E, Eqs. (3)-(5)."""

    percentile: Percent = 99.0
    """p: the edge magnitude at this percentile of tissue pixels maps to 1."""
    border: Literal["reflect", "zero"] = "reflect"
    """How the Sobel filter continues the image in training; `zero` makes bright borders edges (released code)."""


@dataclass(frozen=True)
class PriorConfig:
    """Joint texture prior rho, Eq. (1)."""

    specular: SpecularConfig = field(default_factory=SpecularConfig)
    salience: SalienceConfig = field(default_factory=SalienceConfig)


@dataclass(frozen=True)
class InitConfig(Checked):
    """Where Gaussians start: Eq. (6) and EndoGaussian's pool."""

    sampler: Literal["prior", "uniform", "pool"] = "prior"
    """`prior`: Eq. (6), equal share per frame; `uniform`: the same shares, no prior; `pool`: EndoGaussian's."""
    budget: Positive = 20_000
    """Gaussians to start with. So many pixels are sampled over all training frames."""
    uniform_fraction: Share = 0.45
    """eta_app: share of the probability spread evenly over the eroded tissue mask."""
    erosion_px: Annotated[int, Range(1, 1001)] = 9
    """k: side of the elliptical element that erodes the tissue mask."""
    adaptive_specular: bool = False
    """Raise tau_v to the 97th percentile of brightness in the eroded mask (released code)."""
    salience_on_eroded_mask: bool = False
    """Take the percentile of Eq. (5) over the eroded mask (released code)."""
    salience_border: Literal["reflect", "zero"] = "reflect"
    """How the Sobel filter continues the image while points are sampled; see `prior.salience.border`."""
    pool_fraction: Share = 0.01
    """Share of tissue pixels that each frame gives to EndoGaussian's pool."""
    cleanup: bool = False
    """Voxel merge and statistical outlier removal after sampling (released code)."""
    voxel_divisions: Annotated[int, Range(1, 100_000)] = 400
    """Voxels along the longest side of the point cloud's box."""
    outlier_neighbors: Annotated[int, Range(1, 1000)] = 20
    """Neighbors over which the mean distance is taken."""
    outlier_std: Weight = 1.5
    """Points farther than mean + this many standard deviations are dropped."""
    pixel_offset: Literal["exact", "legacy"] = "exact"
    """`legacy` back-projects integer pixels, half a pixel up and left of their centers (EndoGaussian, released)."""
    variance_factor: Annotated[float, Range(1e-12, 1e6)] = 1.0
    """Initial variance = this times the mean squared distance to the 3 nearest points (released code: 0.4)."""
    thickness: Annotated[float, Range(1e-3, 1)] = 1.0
    """Initial scale along the normal of the surface relative to that along it; 1 starts with spheres."""
    opacity: Annotated[float, Range(1e-4, 0.9999)] = 0.1
    """Initial opacity."""
    fill_unseen: bool = False
    """Also start with points where no frame shows tissue: color and depth continue those around smoothly."""
    motion: Literal["rest", "flow"] = "rest"
    """Start of the temporal coefficients (`kind` basis): no motion, or along tracks of optical flow and depth."""


@dataclass(frozen=True)
class RenderConfig:
    """How splats are rendered."""

    backend: Backend = "numba"
    """`numba`: the CPU; `triton`, `gsplat`: an NVIDIA GPU, by our own kernels or gsplat's; `reference`: PyTorch."""
    depth_grad_to_means: bool = False
    """Let the gradient of rendered depth reach the composited z; EndoGaussian's rasterizer drops it."""
    color_slopes: bool = False
    """The color of a Gaussian changes linearly along its first two axes."""


@dataclass(frozen=True)
class LossConfig(Checked):
    """Supervised terms of Eq. (12)."""

    depth_weight: Weight = 1.0
    """lambda_depth, of the L1 on inverse depth (1 / mm)."""
    edge_weight: Weight = 0.0
    """Of the L1 on differences between neighboring pixels, both on tissue."""
    tv_weight: Weight = 0.03
    """lambda_tv, of the total variation of color and inverse depth over the whole frame."""
    tv_on_tissue: bool = True
    """The total variation counts on visible tissue too; False: only where there is none, as behind tools."""
    cover_weight: Weight = 0.0
    """Of 1 - alpha where something hides the tissue: no holes open behind tools."""
    depth_mode: Literal["accumulated", "expected"] = "accumulated"
    """Depth that is compared: sum of weight * z, or that divided by alpha."""
    min_depth_pixels: Count = 10
    """A frame with fewer measured tissue depths gets no depth loss."""
    track_weight: Weight = 0.0
    """Weight of the distance to the tracks of `init.motion flow`, where the flow found them; 0 switches it off."""
    trust_masks: bool = True
    """Tool masks are right. If not, and a program found them, what looks like a missed tool is left out."""
    tool_margin: Literal["none", "measured"] = "none"
    """`measured`: as many pixels around tools are left out as their color reaches beyond the masks, on this clip."""


@dataclass(frozen=True)
class TemporalConfig(Checked):
    """Texture-aware temporal consistency, Eqs. (9)-(11)."""

    weight: Weight = 1e-6
    """lambda_local; 0 switches the term off."""
    start_iteration: Count = 1000
    """First fine iteration with the term."""
    displacement_weight: Weight = 1.0
    """lambda_disp."""
    distance_weight: Weight = 0.2
    """lambda_dist."""
    num_neighbors: Annotated[int, Range(1, 1000)] = 8
    """K."""
    huber_delta: Annotated[float, Range(1e-12, 1e6)] = 0.01
    """delta, mm."""
    huber_scale: Literal["literal", "released"] = "literal"
    """`released` divides Huber's penalty by delta (smooth L1)."""
    motion_threshold: Threshold = 0.45
    """tau_m."""
    motion_temperature: Annotated[float, Range(1e-30, 1e30)] = 0.08
    """gamma_m."""
    adaptive_motion_weight: bool = False
    """Relax tau_m and gamma_m until `min_effective` Gaussians count (released code)."""
    min_effective: Count = 256
    """Effective sample size sought by the relaxation."""
    pair_weights: bool = True
    """False gives every pair weight 1 (the paper's ablation)."""
    min_valid: Count = 20
    """n_min: projections a Gaussian needs before it takes part."""
    valid_at_both: bool = True
    """Require a projection onto tissue at both times; False: being rendered at time t is enough (released code)."""
    max_points: Count = 0
    """Gaussians sampled by weight for each iteration; 0 takes all that are eligible."""
    refill: bool = False
    """A heavy Gaussian can be hit twice: take the heaviest others until there are `max_points` (released code)."""
    min_points: Count = 128
    """With fewer eligible Gaussians the iteration has no temporal term."""
    gradient: Literal["both", "current"] = "both"
    """Which end of the displacement is trained: both, or only time t (released code)."""


@dataclass(frozen=True)
class DensityConfig(Checked):
    """Growth and pruning, Eqs. (7)-(8) and the rule after them."""

    start_iteration: Count = 500
    """Events happen after this iteration of a stage ..."""
    every: Annotated[int, Range(1, 1_000_000)] = 100
    """... at multiples of this one ..."""
    stop_iteration: Count = 15_000
    """... before this one, and never at the last fine iteration."""
    grow_threshold: Weight = 2e-4
    """Mean screen-space gradient that makes a Gaussian grow, NDC units."""
    min_densify_weight: Share = 0.35
    """lambda_min^den; 1 gives plain 3DGS growth."""
    clone_extent: Weight = 0.01
    """Gaussians with a scale up to this share of the scene extent are cloned, larger ones split."""
    extent_mode: Literal["camera", "scene"] = "camera"
    """`camera`: radius of the camera path (0 for a still camera: split only); `scene`: radius of the points."""
    split_shrink: Annotated[float, Range(1e-3, 1e3)] = 1.6
    """Children of a split have the parent's scale divided by this."""
    prune_opacity: Share = 0.005
    """Gaussians below this opacity are removed."""
    prune_max_scale_mm: Annotated[float, Range(0, 1e9)] = 0.0
    """Gaussians with a larger scale are removed; 0 switches the rule off (released code: 40)."""
    max_scale_share: Weight = 0.0
    """No canonical scale becomes larger than this share of its distance to the camera; 0 sets no limit."""
    prior_prune: bool = True
    """Also remove Gaussians of low prior: n >= n_min, score < tau_prior, mean opacity < tau_alpha."""
    min_valid: Count = 20
    """n_min."""
    prior_threshold: Threshold = 0.2
    """tau_prior."""
    prior_opacity: Threshold = 0.0075
    """tau_alpha."""
    score_mode: Literal["events", "every"] = "every"
    """When s is sampled: at each iteration, or only from the frame of a density event (released code)."""
    unobserved_score: Share = 0.0
    """Score of a Gaussian that was never seen: the paper's 0 / epsilon, or 1 (released code)."""
    max_gaussians: Positive = 200_000
    """Growth stops at this count: a guard, not part of the method."""


@dataclass(frozen=True)
class OptimConfig(Checked):
    """Adam, one learning rate per group. Rates marked * are multiplied by the spatial scale of the sequence.

    The ranges keep parameters finite whatever the finite gradients: a step of Adam with betas 0.9 and 0.999 is at most
    7.3 rates long, so that 2e7 iterations at the largest rate (1e3) and spatial scale (1e6) move nothing beyond 1.5e17.
    """

    means_lr: DecayedRate = 1.6e-4
    """* Initial rate of the centers."""
    means_lr_final: DecayedRate = 1.6e-6
    """* Rate at `decay_iterations`; log-linear in between."""
    network_lr: DecayedRate = 1.6e-4
    """* Initial rate of trunk and heads."""
    network_lr_final: DecayedRate = 1.6e-6
    planes_lr: DecayedRate = 1.6e-3
    """* Initial rate of planes and box."""
    planes_lr_final: DecayedRate = 1.6e-5
    basis_means_lr: Rate = 2e-2
    """Initial rate of the temporal coefficients of the centers, mm."""
    basis_quats_lr: Rate = 2e-3
    basis_log_scales_lr: Rate = 5e-3
    basis_opacity_lr: Rate = 2e-2
    basis_color_lr: Rate = 2.5e-3
    basis_decay: DecayedRate = 0.1
    """Share of these four rates left at `decay_iterations`; log-linear."""
    decay_iterations: Positive = 4000
    """Iterations, counted in each stage, over which the rates above decay."""
    late_decay: DecayedRate = 1.0
    """Share left at `decay_iterations` of the rates below: they stay constant for its first three quarters, then fall
    log-linearly."""
    sh_dc_lr: Rate = 2.5e-3
    sh_rest_lr: Rate = 1.25e-4
    color_slopes_lr: Rate = 2.5e-3
    opacity_lr: Rate = 5e-2
    scales_lr: Rate = 5e-3
    quats_lr: Rate = 1e-3
    epsilon: Annotated[float, Range(1e-30, 1)] = 1e-15
    """Adam's epsilon."""
    basis_epsilon: Annotated[float, Range(1e-30, 1)] = 1e-15
    """Adam's epsilon for the temporal coefficients: gradients well below it hardly move them."""
    still_camera_scale: Weight = 10.0
    """Spatial scale of a sequence with a static camera."""


@dataclass(frozen=True)
class ScheduleConfig(Checked):
    """What happens when."""

    coarse_iterations: Count = 1000
    """Stage one: the first training frame alone, no deformation."""
    fine_iterations: Positive = 3000
    """Training iterations. Stage two: a random training frame each time, deformed."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Highest degree of the color's spherical harmonics."""
    half_resolution_iterations: Count = 0
    """Fine iterations, from the first on, that use frames of half the width and height."""
    sh_every: Positive = 500
    """The degree in use rises by one each time this many iterations of a stage have passed."""


@dataclass(frozen=True)
class WindowConfig(Checked):
    """Where a long sequence is cut. A moving camera sees other tissue after a while; memory should not grow."""

    enabled: bool = False
    """Cut where one of the rules below says so; else the whole sequence is one window."""
    turn_degrees: Annotated[float, Range(0, 180)] = 15.0
    """A window ends where the camera has turned by this since the window's first frame, degrees, ..."""
    shift_share: Weight = 0.1
    """... or has moved by this share of the median depth ..."""
    picture_change: Share = 0.05
    """... or, where the camera moves at all, the picture differs by this: mean absolute difference of color."""
    shortest: Positive = 40
    """These rules count from this frame of a window on."""
    longest: Positive = 200
    """A window ends here at the latest."""
    overlap: Annotated[int, Range(0, 10_000)] = 20
    """Frames that a window shares with the next one: in the middle half of them one fades into the other."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("windows.longest", self.longest, self.shortest, 10_000_000)
        check_range("windows.overlap", self.overlap, 0, self.shortest // 2)


@dataclass(frozen=True)
class Config(Checked):
    """The whole config. Equal configs, data and machine give bit-identical results on a CPU."""

    method: str = OWN
    """Whose rules start, draw, compare and grow: ours, or those of another installed method (docs/methods.md)."""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    """Seed of all random choices. Sampling, initial weights, frame order and splits."""
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
    windows: WindowConfig = field(default_factory=WindowConfig)

    FORMER_FIELDS = ("poses", "loss.fit_relative_depth", "radiance")  # that earlier versions wrote: see `from_dict`

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.init.motion == "flow" and self.deformation.kind != "basis":
            raise InputError(
                f"init.motion: expected rest with deformation.kind {self.deformation.kind}; got flow, which only the "
                "temporal basis can start from. Set --init.motion rest."
            )

    def replace(self, changes: Mapping[str, Any]) -> Config:
        """This config with other values: `preset("default").replace({"iterations": 3000, "optim.means_lr": 2e-3})`.

        Args:
            changes: new value by the field's dotted name (docs/config.md lists all) or short name: `iterations` is
                `schedule.fine_iterations`, `gaussians` is `init.budget`.
        Raises:
            InputError: no field has this name, or the value has the wrong type or range.
        """
        values = to_dict(self)
        override(values, changes, "config")
        return from_dict(type(self), values)

    def fitted(self, num_frames: int) -> Config:
        """The config with the fields filled in that depend on the length of the sequence."""
        return replace(self, deformation=replace(self.deformation, basis=self.deformation.basis.fitted(num_frames)))
