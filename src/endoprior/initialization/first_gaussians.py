"""What the first Gaussians are: where, how large and how turned, how opaque, and how they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..compute.morton import morton_order
from ..core.config import Config
from ..core.types import Frame
from .cleanup import PointCloud, concatenated
from .flow_tracks import InitialMotion, initial_motion
from .normals import flat_along, surface_normals
from .sampling import initial_log_scales, initial_points
from .unseen import unseen_points

UNSEEN_OPACITY = 0.9
"""Initial opacity of what no frame shows: no color asks for it."""


@dataclass(frozen=True)
class FirstGaussians:
    """The start of N Gaussians."""

    cloud: PointCloud
    """Centers, colors and source frames."""
    log_scales: NDArray[np.float32]
    """(N, 3) log of mm."""
    quats: NDArray[np.float32]
    """(N, 4) wxyz."""
    opacities: NDArray[np.float32]
    """(N,) in (0, 1)."""
    motion: InitialMotion | None
    """None: at rest."""


def resting_spheres(cloud: PointCloud, opacity: float) -> FirstGaussians:
    """Spheres at rest, as wide as their neighbors are apart: how 3DGS and what follows it starts.

    Args:
        opacity: in (0, 1).
    """
    num = len(cloud)
    log_scales = np.tile(initial_log_scales(cloud.points)[:, None], 3)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (num, 1))
    return FirstGaussians(cloud, log_scales, quats, np.full(num, opacity, np.float32), None)


def first_gaussians(frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
    """Sample points from the training frames, let them move by optical flow, fill what no frame shows, as `cfg` says.

    Args:
        frames: training frames, in order; the number of basis functions in `cfg` is known.
    Raises:
        InputError: fewer than 4 points.
    """
    init, basis = cfg.init, cfg.deformation.basis
    cloud = initial_points(frames, init, cfg.prior, cfg.seed)
    cloud = cloud.subset(morton_order(cloud.points))
    motion = initial_motion(frames, cloud, basis) if init.motion == "flow" else None
    opacities = np.full(len(cloud), init.opacity, np.float32)
    if init.fill_unseen:
        unseen, coefficients = unseen_points(frames, cloud, motion and motion.coefficients, basis)
        cloud = concatenated([cloud, unseen])
        motion = motion and motion.joined(coefficients)
        opacities = np.concatenate([opacities, np.full(len(unseen), UNSEEN_OPACITY, np.float32)])
    log_scales = np.tile(initial_log_scales(cloud.points, init.variance_factor)[:, None], 3)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(cloud), 1))
    if init.thickness < 1:
        quats = flat_along(surface_normals(cloud, frames))
        log_scales[:, 2] += np.float32(np.log(init.thickness))
    return FirstGaussians(cloud, log_scales, quats, opacities, motion)
