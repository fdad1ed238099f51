"""SurgicalGaussian: a network moves the Gaussians. Xie et al., MICCAI 2024, as released.

Its unit of length is 100 mm, so thresholds and rates that are lengths are 100 times those of the release here. What
differs from the release, and why, is in docs/methods.md. The network of place and time has frequency encodings, which
enter again after the fifth of eight layers of 256, and a head for center, rotation and scale, as in Yang et al.,
"Deformable 3D Gaussians", CVPR 2024.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d, normalize
from typing_extensions import override

from endoprior.compute.frequency_encoding import encoded, encoded_size
from endoprior.compute.neighbors import nearest
from endoprior.compute.relu_network import relu_network
from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.types import Frame, Splats
from endoprior.initialization.first_gaussians import FirstGaussians, resting_spheres
from endoprior.model.gaussians import Gaussians, Offsets
from endoprior.model.motion import Field, ModelOps, Motion
from endoprior.render.projection import rotation_matrices
from endoprior.training import density
from endoprior.training.density import DensityStats, Plan
from endoprior.training.gaussian_hooks import in_epochs
from endoprior.training.losses import total_variation
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import FINAL_SHARE, NETWORK_LR, Rate, log_linear, rate_of
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage

from .released import Released, grid_points

PLACE_BANDS, TIME_BANDS = 10, 4
WIDTH, DEPTH, SKIP_AFTER = 256, 8, 4
HEADS = {"means": 3, "quats": 4, "scales": 3}
INPUTS = encoded_size(3, PLACE_BANDS) + encoded_size(1, TIME_BANDS)


def layer_shapes() -> dict[str, tuple[int, int]]:
    """Outputs and inputs of each layer, by name."""
    shapes = {f"layer.{i}": (WIDTH, INPUTS if i == 0 else WIDTH + INPUTS * (i == SKIP_AFTER + 1)) for i in range(DEPTH)}
    return shapes | {name: (outputs, WIDTH) for name, outputs in HEADS.items()}


def state_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of `TimeNetwork.state_arrays`."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, size in layer_shapes().items():
        shapes |= {f"{name}.weight": size, f"{name}.bias": size[:1]}
    return shapes


class TimeNetwork(Field):
    """Weights by name; PyTorch's default start, the heads' too, so that it moves from the first iteration on."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        self._weights = {name: value.detach().clone().requires_grad_() for name, value in weights.items()}

    @classmethod
    def fresh(cls, generator: torch.Generator) -> TimeNetwork:
        """Uniform in +-1 / sqrt(inputs), weights and biases."""
        weights = {}
        for name, (outputs, inputs) in layer_shapes().items():
            bound = 1 / math.sqrt(inputs)
            for part, size in (("weight", (outputs, inputs)), ("bias", (outputs,))):
                weights[f"{name}.{part}"] = torch.empty(size).uniform_(-bound, bound, generator=generator)
        return cls(weights)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Tensor]) -> TimeNetwork:
        """The network whose `state_arrays` these are.

        Raises:
            InputError: an array is missing or has another shape.
        """
        for name, shape in state_shapes().items():
            if name not in arrays or tuple(arrays[name].shape) != shape:
                raise InputError(f"{name}: expected an array of shape {shape}; got another or none.")
        return cls({name: arrays[name] for name in state_shapes()})

    def __call__(self, places: Tensor, time: float) -> dict[str, Tensor]:
        """Offsets (N, outputs) of each head at places (N, 3) and a time."""
        at_time = encoded(places.new_full((len(places), 1), time), TIME_BANDS)
        inputs = torch.cat([encoded(places, PLACE_BANDS), at_time], -1)
        layers = [self._layer(f"layer.{i}") for i in range(DEPTH)]
        heads = [torch.cat(parts) for parts in zip(*(self._layer(name) for name in HEADS), strict=True)]
        offsets = relu_network(inputs, [*layers, (heads[0], heads[1])], skip=SKIP_AFTER + 1, repeated=INPUTS)
        return dict(zip(HEADS, offsets.split(list(HEADS.values()), -1), strict=True))

    def _layer(self, name: str) -> tuple[Tensor, Tensor]:
        return self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]

    @property
    @override
    def parameters(self) -> dict[str, Tensor]:
        return {f"network.{name}": value for name, value in self._weights.items()}

    @override
    def state_arrays(self) -> dict[str, Tensor]:
        return {name: value.detach() for name, value in self._weights.items()}

    @override
    def to(self, device: torch.device | str, *, fp16_planes: bool = False) -> TimeNetwork:
        device = torch.device(device)
        if next(iter(self._weights.values())).device.type == device.type:
            return self
        return TimeNetwork({name: value.to(device) for name, value in self._weights.items()})


UNIT_MM = 100.0
"""Its unit of length."""
EVERY_PX, FIRST_PX = 3, 1
"""Points start at every third pixel, from the second one on, along both axes."""
COLOR_SHARE, TV_WEIGHT, DEPTH_WEIGHT = 0.8, 0.02, 0.001
DISTANCE_WEIGHT, SHAPE_WEIGHT, NUM_NEIGHBORS = 0.2, 40.0, 4
"""Weights of the sequence `cutting`; those of `pulling` are 0. The release asks for five neighbors and drops itself."""
RESET_EVERY = 3000
MAX_SCALE = 0.1
"""After the reset of opacities at 3,000 larger Gaussians go; units of length.

The release also names a radius of 20 px. In the code that it descends from radii are 0 whenever they are compared:
growth, just before, clears them (docs/log.md). So it is left out.
"""
MIN_SCALE_MM = 1e-6
NETWORK_LATER = 4 / 3
"""The network's rate decays over this many times the iterations of the centers'."""

WINDOW, SIGMA = 11, 1.5
LINE = cv2.getGaussianKernel(WINDOW, SIGMA)
"""(11, 1) the window along one axis."""
C1, C2 = 0.01**2, 0.03**2
TINY = 1e-20
"""Keeps the gradient of a length finite at 0."""


class NetworkMotion(Motion):
    """See `TimeNetwork`. Offsets of scales and rotations are added after activation, as released."""

    @override
    def field(self, points: Tensor, cfg: Config) -> TimeNetwork:
        return TimeNetwork.fresh(torch.Generator().manual_seed(cfg.seed))

    @override
    def field_of(self, arrays: Mapping[str, Tensor], cfg: Config) -> TimeNetwork:
        return TimeNetwork.of_arrays(arrays)

    @override
    def field_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        return state_shapes()

    @override
    def parameter_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        return {f"network.{name}": shape for name, shape in state_shapes().items()}

    @override
    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """A scale that becomes negative counts as its absolute value: the covariance is equal."""
        assert isinstance(field, TimeNetwork)
        rows = slice(None) if chosen is None else chosen
        means, quats, log_scales = (gaussians[name][rows] for name in ("means", "quats", "log_scales"))
        found = field(means.detach() / UNIT_MM, time)
        scales = (log_scales.exp() + UNIT_MM * found["scales"]).abs().clamp(min=MIN_SCALE_MM)
        return Offsets(
            means=UNIT_MM * found["means"],
            log_scales=scales.log() - log_scales,
            quats=normalize(quats, dim=-1) + found["quats"] - quats,
        )


class SurgicalGaussian(Released):
    """See `GaussianMethod`."""

    background = (1.0, 1.0, 1.0)
    first_share = 1 / EVERY_PX**2
    growth_ends, last_reset = 0.375, 0.3
    first_reset, reset_every = 500, RESET_EVERY
    name = "surgicalgaussian"
    way = NetworkMotion()
    changes: ClassVar[Mapping[str, Any]] = {  # published: 40,000 iterations, growth before 15,000, decay over 30,000
        "density.stop_iteration": 1500,
        "density.grow_threshold": 3e-4,
        "optim.scales_lr": 1e-3,
        "optim.decay_iterations": 3000,
        "schedule.coarse_iterations": 0,
        "schedule.fine_iterations": 4000,
        "schedule.sh_every": 1000,
    }

    @override
    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        return resting_spheres(grid_points(frames, EVERY_PX, FIRST_PX), cfg.init.opacity)

    @override
    def position(self, cfg: Config, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        return in_epochs(cfg.seed, stage, iteration, num_frames)

    @override
    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """The network has no length."""
        if not name.startswith("network"):
            return rate_of(name, cfg, UNIT_MM)
        steps = round(NETWORK_LATER * cfg.optim.decay_iterations)
        return lambda iteration: log_linear(NETWORK_LR, FINAL_SHARE * NETWORK_LR, iteration, steps)

    @override
    def terms(self, forward: ForwardPass, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        frame, out, gaussians = forward.frame, forward.out, forward.gaussians
        mask = frame.tissue_mask[..., None]
        color, target = out.color * mask, frame.rgb * mask
        terms = {
            "color": COLOR_SHARE * (color - target).abs().mean(),
            "ssim": (1 - COLOR_SHARE) * (1 - ssim(color, target)),
            "tv": TV_WEIGHT * 2 * total_variation(out.color * ~mask),
            "depth": DEPTH_WEIGHT * ((out.depth - frame.depth) * frame.measured).abs().mean() / UNIT_MM,
        }
        return terms if forward.offsets is None else terms | neighbor_terms(gaussians, forward.offsets, forward.splats)

    @override
    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, stage: Stage, iteration: int, cfg: Config
    ) -> Plan:
        """Also what is large goes, once opacities were reset."""
        planned = density.plan(stats, gaussians.scales, gaussians.opacities, UNIT_MM, cfg.density)
        if iteration <= RESET_EVERY:
            return planned
        large = gaussians.scales.amax(-1) > MAX_SCALE * UNIT_MM
        large &= ~planned.split
        rules = {**planned.removed_by, "size": large}
        return Plan(clone=planned.clone & ~large, split=planned.split, remove=planned.remove | large, removed_by=rules)


def neighbor_terms(gaussians: Gaussians, offsets: Offsets, splats: Splats) -> dict[str, Tensor]:
    """How much the distances between neighbors, and those between their covariances, differ from the canonical ones.

    As released, the deformed covariance has the raw quaternion plus its offset, not the one that is rendered.
    """
    means, quats = gaussians["means"], gaussians["quats"]
    found, _ = nearest(means.detach().cpu().numpy(), min(NUM_NEIGHBORS, len(means) - 1))
    neighbors = torch.from_numpy(found).to(means.device)
    assert offsets.quats is not None
    moved = quats + (offsets.quats + quats - normalize(quats, dim=-1))
    before, after = covariances(quats, gaussians.scales / UNIT_MM), covariances(moved, splats.scales / UNIT_MM)
    return {
        "distance": DISTANCE_WEIGHT * distance_change(means / UNIT_MM, splats.means / UNIT_MM, neighbors),
        "shape": SHAPE_WEIGHT * distance_change(before, after, neighbors),
    }


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two images (H, W, 3), (): Gaussian window of 11 px, zeros outside the frame."""
    smooth = _Smoothed.apply if image.device.type == "cpu" else smoothed
    mean_a, mean_b = smooth(image), smooth(target)
    variance_a, variance_b = smooth(image * image) - mean_a**2, smooth(target * target) - mean_b**2
    covariance = smooth(image * target) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return (luminance * (2 * covariance + C2) / (variance_a + variance_b + C2)).mean()


def smoothed(values: Tensor) -> Tensor:
    """(H, W, 3) values weighted by the window around each pixel; zeros outside."""
    line = torch.as_tensor(LINE, dtype=values.dtype, device=values.device)
    rows = conv2d(values.permute(2, 0, 1)[:, None], line.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))
    return conv2d(rows, line.view(1, 1, 1, -1), padding=(0, WINDOW // 2))[:, 0].permute(1, 2, 0)


class _Smoothed(torch.autograd.Function):
    """`smoothed` by OpenCV, many times faster on a CPU. The window is symmetric, so it is its own gradient."""

    @staticmethod
    def forward(_ctx: Any, values: Tensor) -> Tensor:
        return _by_opencv(values)

    @staticmethod
    @once_differentiable
    def backward(_ctx: Any, v_out: Tensor) -> Tensor:
        return _by_opencv(v_out)


def _by_opencv(values: Tensor) -> Tensor:
    array = values.detach().contiguous().numpy()
    return torch.from_numpy(cv2.sepFilter2D(array, -1, LINE, LINE, borderType=cv2.BORDER_CONSTANT))


def distance_change(before: Tensor, after: Tensor, neighbors: Tensor) -> Tensor:
    """Mean absolute change of the distance between each of N vectors (N, D) and its neighbors (N, K), ()."""

    def lengths(values: Tensor) -> Tensor:
        # The gradient of `values[neighbors]` would be summed by several threads in any order.
        others = values.index_select(0, neighbors.flatten()).view(*neighbors.shape, -1)
        return ((values[:, None] - others) ** 2).sum(-1).add(TINY).sqrt()

    return (lengths(before) - lengths(after)).abs().mean()


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """(N, 6) upper triangle of R S S R^T, from quaternions (N, 4) of any length but zero and scales (N, 3)."""
    axes = rotation_matrices(quats) * scales[:, None, :]
    full = axes @ axes.transpose(1, 2)
    i, j = torch.triu_indices(3, 3, device=full.device)
    return full[:, i, j]


METHOD = SurgicalGaussian()
