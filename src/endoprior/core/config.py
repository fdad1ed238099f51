"""What a user can turn, one frozen dataclass per concern: schema, defaults, command line and manual.

The defaults are the preset `default`; `model/presets.py` says how the others differ. Numbers that have one value
in all presets are constants beside their use. `config_deformation.py` has the fields of the deformation.
"mm" below means the unit of the sequence's depth.

The type of a field states its range. Values beyond it exhaust memory, loop for ever or give NaN, and config files may
come from anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from .checks import InputError, check_range, input_error, read_ranges
from .config_deformation import DeformationConfig
from .config_io import from_dict, override, to_dict
from .ranges import Checked, Count, DecayedRate, Positive, Range, Rate, Share, Threshold, Weight

OWN = "endoprior"
"""Our own method."""
Backend = Literal["reference", "numba", "triton", "gsplat"]
"""What renders: see `render`."""


@dataclass(frozen=True)
class DataConfig(Checked):
    """How frames are read."""

    use_gt_masks: bool = False
    """Read `gt_masks/` (tools only) in place of `masks/` (tools and failed stereo)."""
    lift_missing_depth: bool = False
    """Missing depth becomes the near clip value and counts as measured, as EndoGaussian has it."""
    shrink: Annotated[int, Range(1, 64)] = 1
    """Divide width and height by this. 2 averages blocks of 2 x 2 pixels; higher is faster and less sharp."""
    first_frames: Count = 0
    """Read only the first frames, so many; 0 reads all."""
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
    reliability: Literal["used", "ignored"] = "used"
    """`used`: frames without a camera pose are neither trained on nor scored, and blurred, hazy or saturated ones count
    less. `ignored`: all count alike, as published."""
    eyes: Literal["left", "both"] = "left"
    """Cameras whose images are trained on, in turn at random; `both` needs the right images (docs/scores.md). Each
    sees its own highlights and has half of the iterations: `endoprior train` doubles them unless you set them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        read_ranges("skip_frames", self.skip_frames)
        read_ranges("window", self.window)


@dataclass(frozen=True)
class InitConfig(Checked):
    """Where Gaussians start: Eq. (6) and EndoGaussian's pool."""

    sampler: Literal["prior", "uniform", "pool"] = "prior"
    """`prior`: Eq. (6), equal share per frame; `uniform`: the same shares, no prior; `pool`: EndoGaussian's."""
    budget: Positive = 30_000
    """Gaussians to start with. More show finer detail, and take more time and memory."""
    variance_factor: Annotated[float, Range(1e-12, 1e6)] = 0.4
    """Initial variance = this times the mean squared distance to the 3 nearest points: higher is more blurred."""
    thickness: Annotated[float, Range(1e-3, 1)] = 0.3
    """Initial scale along the normal of the surface relative to that along it; 1 starts with spheres."""
    opacity: Annotated[float, Range(1e-4, 0.9999)] = 0.3
    """Initial opacity. Higher hides what lies behind from the start."""
    fill_unseen: bool = True
    """Also start with points where no frame shows tissue: color and depth continue those around smoothly."""
    motion: Literal["rest", "flow"] = "flow"
    """Start of the temporal coefficients (`kind` basis): no motion, or along tracks of optical flow and depth."""


@dataclass(frozen=True)
class RenderConfig:
    """How splats are rendered."""

    backend: Backend = "numba"
    """`numba`: the CPU; `triton`, `gsplat`: an NVIDIA GPU, by our own kernels or gsplat's; `reference`: PyTorch."""
    depth_grad_to_means: bool = True
    """Let the gradient of rendered depth reach the composited z; EndoGaussian's rasterizer drops it."""
    color_slopes: bool = True
    """The color of a Gaussian changes linearly along its first two axes: finer texture with as many Gaussians."""
    photometric: Literal["auto", "none", "smoke"] = "auto"
    """What lies between tissue and camera: `smoke`, a veil of each frame; `auto`: one if training frames show smoke."""


@dataclass(frozen=True)
class LossConfig(Checked):
    """Supervised terms of Eq. (12). That of color has the weight 1."""

    depth_weight: Weight = 6.0
    """Weight of the L1 on inverse depth, mm: higher follows the measured depth more closely, noise included."""
    edge_weight: Weight = 0.5
    """Weight of the L1 on differences between neighboring pixels, both on tissue: higher gives sharper edges."""
    tv_weight: Weight = 0.003
    """Weight of the total variation of color and inverse depth: higher is smoother."""
    cover_weight: Weight = 0.01
    """Weight of 1 - alpha where something hides the tissue: no holes open behind tools. Above 0, the total variation
    counts only where no tissue is visible; 0: over the whole frame."""
    track_weight: Weight = 0.02
    """Weight per mm of the distance to the tracks of `init.motion flow`: higher holds tissue closer to them; 0: off."""
    trust_masks: bool = False
    """Tool masks are right. If not, and a program found them, what looks like a missed tool is left out."""


@dataclass(frozen=True)
class TemporalConfig(Checked):
    """Texture-aware temporal consistency, Eqs. (9)-(11)."""

    weight: Weight = 1e-6
    """lambda_local, per mm: higher makes neighbors move more alike; 0 switches the term off."""
    start_iteration: Count = 450
    """First fine iteration with the term."""
    without: Literal["nothing", "pair_weights", "distance"] = "nothing"
    """Part that is left out, as in the paper's ablation: the weights of pairs, or the term of their distances."""
    min_valid: Count = 1
    """n_min: projections onto tissue that a Gaussian needs to take part; higher leaves out those rarely seen."""
    min_points: Count = 128
    """With fewer Gaussians to take part the iteration has no temporal term."""
    gradient: Literal["both", "current"] = "current"
    """`current`: trains time t, with 1,024 of the Gaussians rendered then. `both`: trains both times, as the paper
    says, with all Gaussians that project onto tissue at both; many times slower."""


@dataclass(frozen=True)
class DensityConfig(Checked):
    """Growth and pruning, Eqs. (7)-(8) and the rule after them."""

    start_iteration: Count = 450
    """Gaussians are cloned, split and removed after this iteration of a stage ..."""
    every: Annotated[int, Range(1, 1_000_000)] = 100
    """... at multiples of this one ..."""
    stop_iteration: Count = 15_000
    """... before this one, and never at the last fine iteration."""
    grow_threshold: Weight = 3e-4
    """Mean screen-space gradient, NDC units, that makes a Gaussian grow. Lower gives more Gaussians."""
    min_densify_weight: Share = 0.35
    """lambda_min^den: how much Gaussians without texture grow, relative to others. 1: growth and pruning of plain 3DGS,
    in which the prior has no part."""
    prune_opacity: Share = 0.005
    """Gaussians below this opacity are removed. Higher keeps fewer."""
    prior_threshold: Threshold = 0.2
    """tau_prior: Gaussians of a lower prior score are removed if they are faint and seen often. Higher removes more."""
    min_valid: Count = 20
    """n_min: projections onto tissue at which a score must have been sampled before it removes a Gaussian."""


@dataclass(frozen=True)
class OptimConfig(Checked):
    """Adam. What has no rate here has a constant one, in `training/optimizer.py`.

    The ranges keep parameters finite whatever the finite gradients: a step of Adam with betas 0.9 and 0.999 is at most
    7.3 rates long, so that 2e7 iterations at the largest rate (1e3) and spatial scale (1e6) move nothing beyond 1.5e17.
    """

    means_lr: DecayedRate = 8e-3
    """Initial rate of the centers, in units of the spatial scale of the sequence; a hundredth of it is left at
    `decay_iterations`. Higher finds the place sooner, too high blurs."""
    basis_lr: Rate = 3e-2
    """Initial rate of the temporal coefficients, mm for the centers; a tenth of it is left at `decay_iterations`.
    Higher follows fast motion sooner, too high makes tissue tremble."""
    scales_lr: Rate = 3e-2
    """Rate of the log scales."""
    quats_lr: Rate = 2e-2
    """Rate of the rotations."""
    decay_iterations: Positive = 1350
    """Iterations, counted in each stage, over which rates decay: the number of fine iterations, or a little more."""
    late_decay: DecayedRate = 0.1
    """Share of the rates of scales, rotations, opacities and colors that is left at `decay_iterations`: they are
    constant for its first three quarters, then fall log-linearly. 1: they stay constant, which leaves noise."""


@dataclass(frozen=True)
class ScheduleConfig(Checked):
    """What happens when."""

    coarse_iterations: Count = 0
    """Stage one: the first training frame alone, no deformation. 0 leaves the stage out."""
    fine_iterations: Positive = 1350
    """Training iterations. Stage two: one training frame each time, deformed. More is better, and takes longer."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Highest degree of the color's spherical harmonics: above 0 color depends on the direction of view."""
    half_resolution_iterations: Count = 450
    """Fine iterations, from the first on, that use frames of half the width and height: more is faster, less sharp."""
    sh_every: Positive = 500
    """The degree in use rises by one each time this many iterations of a stage have passed."""
    literal: bool = False
    """The schedule is a published one. When `iterations` changes, the numbers of what begins and ends stay; and an
    iteration takes any frame at random. Else each epoch takes every training frame once, in random order."""

    @property
    def total(self) -> int:
        """Iterations of both stages."""
        return self.coarse_iterations + self.fine_iterations


@dataclass(frozen=True)
class WindowConfig(Checked):
    """Where a long sequence is cut. A moving camera sees other tissue after a while; memory should not grow."""

    longest: Count = 200
    """Most frames of a window, at least 4. Fewer need less memory and make more seams; 0: the whole sequence is one."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("windows.longest", self.longest or 4, 4, 10_000_000)


@dataclass(frozen=True)
class ReleasedMethod(Checked):
    """What the authors' released code, and EndoGaussian's, do otherwise than the paper says; only to compare."""

    prior: bool = False
    """The prior of the released code. At the start: tau_v rises with the brightness of the frame, and the percentile is
    that of the eroded mask. In training: bright image borders count as edges, scores are sampled at density events
    only, and 1 where nothing was sampled. Temporal term: Huber's penalty is divided by its threshold, weights are
    relaxed until enough Gaussians count, and samples are filled up."""
    cleanup: bool = False
    """Voxel merge and statistical outlier removal of the first points."""
    half_pixel_shift: bool = False
    """Back-project integer pixels, half a pixel up and left of their centers; EndoGaussian does too."""
    zero_biases: bool = False
    """Biases of the deformation network start at 0, not as PyTorch draws them."""
    prune_max_scale_mm: Annotated[float, Range(0, 1e9)] = 0.0
    """Gaussians with a larger scale are removed, mm (released code: 40); 0: none is."""

    @property
    def unobserved_score(self) -> float:
        """Score of a Gaussian that was never seen: the paper's 0 / epsilon, or 1."""
        return 1.0 if self.prior else 0.0


@dataclass(frozen=True)
class Config(Checked):
    """The whole config. Equal configs, data and machine give bit-identical results on a CPU."""

    method: str = OWN
    """Method that starts, moves, compares and grows the Gaussians: ours, or another installed one (docs/methods.md)."""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    """Seed of all random choices. Sampling, initial weights, frame order and splits."""
    fit_to_clip: bool = False
    """Fit a published method to the clip: its length, its camera's path, the training's length (docs/methods.md)."""
    data: DataConfig = field(default_factory=DataConfig)
    init: InitConfig = field(default_factory=InitConfig)
    deformation: DeformationConfig = field(default_factory=DeformationConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    temporal: TemporalConfig = field(default_factory=TemporalConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    released: ReleasedMethod = field(default_factory=ReleasedMethod)

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
            changes: new value by the field's dotted name (docs/config.md lists all) or short name: `gaussians` is
                `init.budget`; `iterations` is the length of the training, of which what begins and ends in between
                keeps its share (`set_iterations`).
        Raises:
            InputError: no field has this name, or the value has the wrong type or range.
        """
        values = to_dict(self)
        override(values, changes, "config")
        return from_dict(type(self), values)

    def extended(self, total: int) -> Config:
        """The config of a run that goes on until so many iterations: rates stay low, and growth does not begin anew.

        Raises:
            InputError: the coarse stage alone is as long.
        """
        coarse, fine = self.schedule.coarse_iterations, self.schedule.fine_iterations
        if total == self.schedule.total:
            return self
        if total <= coarse:
            want = f"more than the {coarse:,} of the coarse stage"
            raise input_error("--iterations", want, f"{total:,}", "choose more.")
        if self.fit_to_clip:
            want, fix = "the same length, of which --fit-to-clip takes shares", "Train anew with --iterations."
            raise input_error("--iterations", want, f"{total:,}", fix)
        density = replace(self.density, stop_iteration=min(self.density.stop_iteration, fine))
        return replace(self, schedule=replace(self.schedule, fine_iterations=total - coarse), density=density)

    def fitted(self, num_frames: int) -> Config:
        """The config with the fields filled in that depend on the length of the sequence."""
        deformation = self.deformation
        if self.fit_to_clip:
            deformation = replace(deformation, hexplane=deformation.hexplane.fitted(num_frames))
        return replace(self, deformation=replace(deformation, basis=deformation.basis.fitted(num_frames)))
