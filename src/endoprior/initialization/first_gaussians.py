"""What the first Gaussians are: where, how large and how turned, how opaque, and how they move.

They can start flat along the surface, whose normals come from measured depth. A plane has an inverse depth that is
linear in the pixel: 1 / z = a x' + b y' + c with x' = (x - cx) / fx and y' alike, and (a, b, c) is along its normal.
`P` points, `W` pixels of a window.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..compute.morton import morton_order
from ..core.config import Config
from ..core.geometry import cells_at, project
from ..core.types import Frame
from ..model.gaussians import SH_C0, Gaussians, attribute_shapes
from ..model.method import method_of
from ..system.memory import workers
from .flow_tracks import initial_motion
from .motion_fit import InitialMotion
from .sampling import PointCloud, concatenated, has_surface, initial_log_scales, initial_points
from .unseen import unseen_points

WINDOW_SHARE = 1 / 60  # width of the window in which a plane is fitted, as a share of the image's
SAME_SURFACE = 0.03  # pixels whose depth differs by more than this share belong to other tissue
PLAIN = 1e-4
"""Pull towards a plane at right angles to the ray, where a window holds too few pixels: share of the fit's weight."""
UNSEEN_OPACITY = 0.9  # initial opacity of what no frame shows: no color asks for it
BYTES_PER_POINT = 100  # memory for each pixel of each window, bytes


def surface_normals(cloud: PointCloud, frames: Sequence[Frame]) -> NDArray[np.float32]:
    """(P, 3) unit normals in world axes, away from the camera, each from the depth around its point's source pixel.

    Args:
        frames: those that the points were sampled from; `cloud.origins` are their positions.
    """
    normals = np.zeros((len(cloud), 3), np.float32)

    def fill(position: int) -> None:
        rows = np.flatnonzero(cloud.origins == position)
        if len(rows):
            normals[rows] = _normals_of_frame(cloud.points[rows].astype(np.float64), frames[position])

    most = int(np.bincount(cloud.origins, minlength=1).max(initial=0))
    with ThreadPoolExecutor(workers(BYTES_PER_POINT * most * _window(frames[0]) ** 2)) as pool:
        list(pool.map(fill, range(len(frames))))
    return normals


def flat_along(normals: NDArray) -> NDArray[np.float32]:
    """(P, 4) quaternions wxyz that turn the third axis of a Gaussian to the unit `normals` (P, 3)."""
    x, y, z = normals.T.astype(np.float64)
    quats = np.stack([1 + z, -y, x, np.zeros_like(z)], -1)
    quats[z < -1 + 1e-9] = (0, 1, 0, 0)  # half a turn
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def _window(frame: Frame) -> int:
    """Width of the window, px: odd, 5 or more."""
    return max(int(frame.camera.width * WINDOW_SHARE) // 2 * 2 + 1, 5)


def _normals_of_frame(points: NDArray, frame: Frame) -> NDArray:
    """Weighted least squares in the window around each point; (P, 3)."""
    camera, reach = frame.camera, _window(frame) // 2
    pixels, _ = project(points, camera)
    x, y = cells_at(pixels, camera.width, camera.height)
    usable = frame.tissue_mask & has_surface(frame)
    inverse = np.divide(1.0, frame.depth, out=np.zeros(frame.depth.shape), where=usable)
    steps = np.arange(-reach, reach + 1)
    dy, dx = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    column, row = x[:, None] + dx, y[:, None] + dy
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    found = np.where(inside, inverse[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)], 0)
    center = inverse[y, x][:, None]
    weight = (np.abs(found - center) < SAME_SURFACE * center).astype(np.float64)
    # Coordinates around the point, in windows: the normal equations stay well conditioned.
    terms = np.stack([dx / reach, dy / reach, np.ones(len(dx))])
    normal = np.einsum("iw,pw,jw->pij", terms, weight, terms)
    normal[:, [0, 1], [0, 1]] += PLAIN * len(dx)
    normal[:, 2, 2] += 1e-9
    sums = np.einsum("iw,pw->pi", terms, weight * found)
    slope_x, slope_y, level = np.linalg.solve(normal, sums[..., None])[..., 0].T
    a, b = slope_x / reach * camera.fx, slope_y / reach * camera.fy
    c = level - a * (x + 0.5 - camera.cx) / camera.fx - b * (y + 0.5 - camera.cy) / camera.fy
    n = np.stack([a, b, c], -1)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.where(length > 0, n / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
    return n @ camera.world_to_camera[:3, :3]


@dataclass(frozen=True)
class FirstGaussians:
    """The start of N Gaussians."""

    cloud: PointCloud  # centers, colors and source frames
    log_scales: NDArray[np.float32]  # (N, 3) log of mm
    quats: NDArray[np.float32]  # (N, 4) wxyz
    opacities: NDArray[np.float32]  # (N,) in (0, 1)
    motion: InitialMotion | None  # None: at rest


def resting_spheres(cloud: PointCloud, opacity: float, variance_factor: float = 1.0) -> FirstGaussians:
    """Spheres at rest, as wide as their neighbors are apart: how 3DGS and what follows it starts.

    Args:
        opacity: in (0, 1). variance_factor: multiplies the squared width.
    """
    num = len(cloud)
    log_scales = np.tile(initial_log_scales(cloud.points, variance_factor)[:, None], 3)
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
    cloud = initial_points(frames, init, cfg.released, cfg.seed)
    cloud = cloud.subset(morton_order(cloud.points))
    num_seen = len(cloud)
    motion = initial_motion(frames, cloud, basis) if init.motion == "flow" else None
    if init.fill_unseen:
        unseen, motion = unseen_points(frames, cloud, motion, basis)
        cloud = concatenated([cloud, unseen])
    first = replace(resting_spheres(cloud, init.opacity, init.variance_factor), motion=motion)
    first.opacities[num_seen:] = UNSEEN_OPACITY
    if init.thickness < 1:
        first.quats[:] = flat_along(surface_normals(cloud, frames))
        first.log_scales[:, 2] += np.float32(np.log(init.thickness))
    return first


def create_gaussians(
    points: NDArray,
    colors: NDArray,
    log_scales: NDArray,
    cfg: Config,
    quats: NDArray | None = None,
    opacities: NDArray | None = None,
) -> Gaussians:
    """Gaussians at the initial points, of the points' color, at rest.

    Args:
        points: (N, 3) mm. colors: (N, 3) in [0, 1]. log_scales: (N,) for spheres or (N, 3), log of mm.
        quats: (N, 4) wxyz; None: unrotated. opacities: (N,) in (0, 1); None: `cfg.init.opacity`.
    Raises:
        InputError: the config leaves the number of temporal basis functions open.
    """
    num = len(points)
    log_scales = np.asarray(log_scales, np.float32)
    log_scales = np.broadcast_to(log_scales[:, None] if log_scales.ndim == 1 else log_scales, (num, 3))
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (num, 1)) if quats is None else quats
    chances = np.full(num, cfg.init.opacity) if opacities is None else np.asarray(opacities, np.float64)
    tensors = {
        "means": torch.from_numpy(np.ascontiguousarray(points, np.float32)),
        "quats": torch.from_numpy(np.array(quats, np.float32)),
        "log_scales": torch.from_numpy(np.array(log_scales)),
        "opacity_logits": torch.from_numpy(np.log(chances / (1 - chances)).astype(np.float32)),
        "sh_dc": (torch.from_numpy(np.asarray(colors, np.float32))[:, None, :] - 0.5) / SH_C0,
    }
    # Everything else starts at zero: color that does not depend on the view, and is one in each Gaussian.
    zeros = {name: torch.zeros(num, *shape) for name, shape in attribute_shapes(cfg).items() if name not in tensors}
    return Gaussians(tensors | zeros | method_of(cfg).motion(cfg).first_tensors(num, cfg))
