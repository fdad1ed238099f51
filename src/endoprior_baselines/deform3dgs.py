"""Deform3DGS: Gaussians move by learned functions of time. Yang et al., MICCAI 2024, as released.

It starts from the surface of the first frame and what other frames show that it does not, but from training frames
only (`Deform3DGS@b06f0a5`). Its loss and its density control are the defaults, with the weights of `config`. What
differs from the release, and why, is in docs/methods.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from endoprior.core.config import Config
from endoprior.core.geometry import project
from endoprior.core.ranges import Range
from endoprior.core.types import Frame
from endoprior.initialization.first_gaussians import FirstGaussians, resting_spheres
from endoprior.initialization.sampling import PointCloud, concatenated, has_surface
from endoprior.model.gaussians import Gaussians, Offsets
from endoprior.model.motion import Field, ModelOps, Motion
from endoprior.training.optimizer import Rate, rate_of

from .learned_basis import COEFFICIENTS, value_at
from .released import Released, enough, surface_points

NUM_BASES = 17
"""Basis functions of each Gaussian and channel."""
CHANNELS = {"means": 3, "quats": 4, "log_scales": 3}
"""What moves, in the order of the channels."""
FIRST_WIDTH = 0.01
OVERLAPPING_WIDTH = 0.035
"""With this first width, 0.56 of the distance of their centers, neighboring basis functions overlap."""
SPATIAL_SCALE = 10.0
"""Factor of the rates of centers and coefficients, whatever the camera does."""
MOVING_PERCENTILE = 95.0
"""A pixel moves if its gray level departs from its mean over time by more than this percentile of all departures."""
MANY_FRAMES = 150
"""With more frames, every second one adds points."""
MIN_NEW = 50
"""A frame that shows no more new pixels adds none."""
SHARE = 0.1
"""Of the new pixels of a frame that are added, and of all points that are kept at the end."""
MAX_POINTS, DRAWN = 600_000, 500_000
"""Of more points than the first number, so many are drawn."""


@dataclass(frozen=True)
class Deform3DGSConfig(Config):
    """See `Config`."""

    first_width: Annotated[float, Range(1e-4, 1)] = FIRST_WIDTH
    """Width of the basis functions at the start, as a share of the clip."""


def first_width_of(cfg: Config) -> float:
    """`Deform3DGSConfig.first_width`."""
    assert isinstance(cfg, Deform3DGSConfig)
    return cfg.first_width


class LearnedBasisMotion(Motion):
    """Coefficients of each Gaussian: weight, center and width of 17 basis functions in each of 10 channels."""

    @override
    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        return dict.fromkeys(COEFFICIENTS, (NUM_BASES, sum(CHANNELS.values())))

    @override
    def first_tensors(self, num: int, cfg: Config) -> dict[str, Tensor]:
        size = (num, NUM_BASES, sum(CHANNELS.values()))
        centers = torch.linspace(0, 1, NUM_BASES)[None, :, None].expand(size)
        return dict(zip(COEFFICIENTS, (torch.zeros(size), centers, torch.full(size, first_width_of(cfg))), strict=True))

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
        """Unless some are chosen, the gradient goes to `gaussians.motion_gradients`."""
        weights, centers, widths = (
            gaussians[name] if chosen is None else gaussians[name][chosen] for name in COEFFICIENTS
        )
        sink = gaussians.motion_gradients if chosen is None else None
        parts = value_at(weights, centers, widths, time, sink).split(list(CHANNELS.values()), 1)
        return Offsets(**dict(zip(CHANNELS, parts, strict=True)))


class Deform3DGS(Released):
    """See `GaussianMethod`."""

    color_is_error = True
    first_share = SHARE
    clone_extent = 0.0  # what grows is split
    config_type = Deform3DGSConfig
    name = "deform3dgs"
    way = LearnedBasisMotion()
    changes: ClassVar[Mapping[str, Any]] = {  # the rates are those of 3DGS: the defaults
        "loss.tv_weight": 0.0,
        "schedule.coarse_iterations": 0,
    }

    @override
    def config(self) -> Config:
        return Deform3DGSConfig(**vars(super().config()))

    @override
    def fitted(self, cfg: Config, num_frames: int) -> Config:
        """A basis function reaches into its neighbors, and at least one frame far."""
        cfg = super().fitted(cfg, num_frames)
        assert isinstance(cfg, Deform3DGSConfig)
        return replace(cfg, first_width=max(OVERLAPPING_WIDTH, 1 / num_frames)) if cfg.fit_to_clip else cfg

    @override
    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        return resting_spheres(first_points(frames, cfg.seed), cfg.init.opacity)

    @override
    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """Coefficients learn as centers do."""
        return rate_of("means" if name in COEFFICIENTS else name, cfg, SPATIAL_SCALE)


METHOD = Deform3DGS()


def first_points(frames: Sequence[Frame], seed: int) -> PointCloud:
    """A tenth of the points of the first training frame, and of what is uncovered later or moves there.

    Raises:
        InputError: fewer than 4 points.
    """
    rng, first = np.random.default_rng(seed), frames[0]
    covered, moving = _surface(first, 0.1, 99.9), _moving(frames)
    clouds = [surface_points(first, 0, covered)]
    step = 2 if len(frames) > MANY_FRAMES else 1
    for position in range(1, len(frames), step):
        cloud = surface_points(frames[position], position, _surface(frames[position], 3.0, 99.8))
        inside, cells = _cells(cloud.points, first)
        new = inside.copy()
        new[inside] = ~covered.reshape(-1)[cells[inside]] | moving.reshape(-1)[cells[inside]]
        if np.count_nonzero(new) > MIN_NEW:
            rows = np.flatnonzero(new)
            clouds.append(cloud.subset(rng.choice(rows, int(SHARE * len(rows)))))
            covered.reshape(-1)[cells[new]] = True
    cloud = concatenated(clouds)
    if len(cloud) > MAX_POINTS:
        cloud = cloud.subset(rng.integers(len(cloud), size=DRAWN))
    cloud = cloud.subset(np.sort(rng.choice(len(cloud), int(SHARE * len(cloud)), replace=False)))
    return enough(cloud, ", a tenth of the tissue pixels with depth")


def _surface(frame: Frame, low: float, high: float) -> NDArray[np.bool_]:
    """(H, W) tissue with a depth between two percentiles of all depths of the frame."""
    depths = frame.depth[frame.depth_valid]
    if not len(depths):
        return np.zeros_like(frame.tissue_mask)
    near, far = np.percentile(depths, [low, high])
    return frame.tissue_mask & has_surface(frame) & (frame.depth >= near) & (frame.depth <= far)


def _moving(frames: Sequence[Frame]) -> NDArray[np.bool_]:
    """(H, W) pixels of the first frame whose gray level differs much from its mean over time."""
    mean = np.zeros(frames[0].tissue_mask.shape)
    for frame in frames:
        mean += frame.rgb_u8.mean(-1) / len(frames)
    away = np.abs(frames[0].rgb_u8.mean(-1) - mean)
    departed = away[away > 0]
    return away > np.percentile(departed, MOVING_PERCENTILE) if len(departed) else np.zeros(away.shape, bool)


def _cells(points: NDArray[np.float32], first: Frame) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Which of P points the first frame's camera sees, (P,), and the flat index of their pixel there, (P,)."""
    camera = first.camera
    pixels, z = project(points.astype(np.float64), camera)
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
    cells = np.where(inside[:, None], pixels, 0).astype(np.intp)
    return inside, cells[:, 1] * camera.width + cells[:, 0]
