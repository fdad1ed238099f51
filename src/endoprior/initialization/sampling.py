"""Initial points: sample pixels from the prior (or uniformly), back-project them by depth, clean up. Paper Eq. (6).

`H, W` image size, `N` points, `F` training frames, `B` budget. NumPy only.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..core.checks import check_shape, input_error
from ..core.config import InitConfig, ReleasedMethod
from ..core.geometry import FARTHEST_MM, back_project
from ..core.types import Frame
from ..priors import joint_texture_prior
from ..priors.specular import VALUE_THRESHOLD
from ..render.constants import NEAR_Z
from ..system.memory import workers

UNIFORM_FRACTION = 0.45  # eta_app: share of the probability spread evenly over the eroded tissue mask
EROSION_PX = 9  # k: side of the elliptical element that erodes the tissue mask
POOL_FRACTION = 0.01  # share of tissue pixels that each frame gives to EndoGaussian's pool
VOXEL_DIVISIONS, OUTLIER_NEIGHBORS, OUTLIER_STD = 400, 20, 1.5
"""Clean-up of the released code: voxels along the longest side of the box; points are dropped whose mean distance to so
many neighbors is above the mean by more than so many standard deviations."""
EPSILON = 1e-6  # keeps Eq. (6) finite where the mask or the prior is empty
MIN_SQUARED_SPACING = 1e-7  # mm^2; initial scale of points that coincide, as EndoGaussian sets it
ADAPTIVE_PERCENTILE = 97.0  # percentile of brightness that raises tau_v (released code)
PRIOR_BYTES = 200  # memory per pixel while sampling the points of a frame, bytes
GUESSED = 0.5  # how far a depth that is a guess is believed beside one that was measured
MIN_POINTS = 4  # the initial scale needs three neighbors

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PointCloud:
    """Colored points."""

    points: NDArray[np.float32]  # (N, 3) world coordinates, mm
    colors: NDArray[np.float32]  # (N, 3) red, green, blue in [0, 1]
    origins: NDArray[np.int32]  # (N,) position of the source frame of each point in the list of sampled frames

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, rows: NDArray) -> PointCloud:
        """The points selected by `rows`, indices or a mask."""
        return PointCloud(self.points[rows], self.colors[rows], self.origins[rows])


def concatenated(clouds: list[PointCloud]) -> PointCloud:
    """One cloud of all points; an empty list gives an empty cloud."""
    empty = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    parts = [(cloud.points, cloud.colors, cloud.origins) for cloud in clouds or [empty]]
    return PointCloud(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def merge_voxels(cloud: PointCloud, divisions: int) -> PointCloud:
    """Replace the points of each voxel by their mean position and mean color, with the origin of the first one.

    Args:
        cloud: finite points.
        divisions: number of voxels along the longest side of the bounding box, whose corner is the center of a voxel.
    Returns:
        One point per occupied voxel, ordered by voxel (x, then y, then z).
    """
    if len(cloud) == 0:
        return cloud
    points = cloud.points.astype(np.float64)
    low = points.min(0)
    side = (points.max(0) - low).max() / divisions
    if side == 0:  # all points coincide
        color = cloud.colors.mean(0, dtype=np.float64, keepdims=True).astype(np.float32)
        return PointCloud(cloud.points[:1], color, cloud.origins[:1])
    voxel = np.floor((points - low) / side + 0.5).astype(np.int64)
    _, first, owner, count = np.unique(voxel, axis=0, return_index=True, return_inverse=True, return_counts=True)
    owner = owner.reshape(-1)

    def mean(values: NDArray[np.floating]) -> NDArray[np.float32]:
        sums = [np.bincount(owner, values[:, c], len(count)) for c in range(3)]
        return (np.stack(sums, -1) / count[:, None]).astype(np.float32)

    return PointCloud(mean(points), mean(cloud.colors), cloud.origins[first])


def remove_outliers(cloud: PointCloud, num_neighbors: int, num_std: float) -> PointCloud:
    """Remove points whose mean distance to their nearest points is unusually large; all stay if there are too few.

    Args:
        num_neighbors: number of nearest points in the mean, including the point itself (distance 0).
        num_std: points above the mean plus this many standard deviations are removed.
    """
    if len(cloud) <= num_neighbors:
        return cloud
    distance, _ = KDTree(cloud.points).query(cloud.points, k=num_neighbors)
    average = distance.reshape(len(cloud), -1).mean(1)
    keep = average <= average.mean() + num_std * average.std(ddof=1)
    return cloud.subset(keep)


def initial_points(
    frames: Sequence[Frame], cfg: InitConfig | None = None, released: ReleasedMethod | None = None, seed: int = 0
) -> PointCloud:
    """Sample at most `cfg.budget` surface points from the training frames, never from test frames.

    `prior` and `uniform` sample the same number of points from every frame, without replacement. `pool` is the sampler
    of EndoGaussian: it pools a share of the tissue of every frame and samples the budget with replacement, so points
    repeat. Only pixels with measured depth are used. If a frame has too few, all are used and a warning is logged.

    Raises:
        InputError: fewer than 4 points are left.
    """
    cfg, released = cfg or InitConfig(), released or ReleasedMethod()
    shares = quotas(cfg.budget, len(frames))

    def sample(position: int) -> tuple[PointCloud, int]:
        """Points of one frame, and the number of missing points."""
        frame, count = frames[position], shares[position]
        if frame.weight is not None:  # a frame that is believed less gives fewer points
            count = round(count * float(frame.weight.max()))
        probability = pixel_probability(frame, cfg, released.prior)
        available = int(np.count_nonzero(probability))
        if cfg.sampler == "pool":
            count = min(available, max(1, int(POOL_FRACTION * available)))
        flat = sample_pixels(probability, count, np.random.default_rng([seed, position]))
        v, u = np.divmod(flat, frame.camera.width)
        pixels = np.stack([u, v], -1) + (0.0 if released.half_pixel_shift else 0.5)
        points = back_project(pixels, frame.depth[v, u].astype(np.float64), frame.camera).astype(np.float32)
        colors = frame.rgb_u8[v, u].astype(np.float32) / np.float32(255)
        return PointCloud(points, colors, np.full(len(points), position, np.int32)), max(0, count - available)

    threads = workers(PRIOR_BYTES * frames[0].tissue_mask.size) if len(frames) else 1
    with ThreadPoolExecutor(threads) as pool:  # NumPy and OpenCV release the interpreter lock
        samples = list(pool.map(sample, range(len(frames))))
    cloud, missing = concatenated([points for points, _ in samples]), sum(missed for _, missed in samples)
    if cfg.sampler == "pool" and len(cloud):
        cloud = cloud.subset(np.random.default_rng(seed).integers(len(cloud), size=cfg.budget))
    if released.cleanup:
        num_sampled = len(cloud)
        cloud = remove_outliers(merge_voxels(cloud, VOXEL_DIVISIONS), OUTLIER_NEIGHBORS, OUTLIER_STD)
        log.info("initialization: %d of %d points left after clean-up", len(cloud), num_sampled)
    if len(cloud) < MIN_POINTS:
        want = f"at least {MIN_POINTS} tissue pixels with depth between {NEAR_Z:g} and {FARTHEST_MM:g} mm"
        fix = "Check masks, depth and its unit with `endoprior check DATA`, and the budget."
        raise input_error("initialization", f"{want} in the training frames", str(len(cloud)), fix)
    if missing:
        log.warning("initialization: %d of %d points are missing, too few tissue pixels", missing, cfg.budget)
    return cloud


def has_surface(frame: Frame) -> NDArray[np.bool_]:
    """(H, W) True where depth was measured and lies behind the near plane of the renderer; meters never do."""
    return frame.depth_valid & (frame.depth > NEAR_Z) & (frame.depth < FARTHEST_MM)


def depth_weight(confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) how far a depth of some confidence (H, W) is believed: from `GUESSED` for a guess to 1."""
    return np.float32(GUESSED) + np.float32(1 - GUESSED) * confidence


def pixel_probability(frame: Frame, cfg: InitConfig, released_prior: bool = False) -> NDArray[np.float64]:
    """(H, W) sampling weight >= 0 of each pixel for the sampler of `cfg`; 0 outside tissue or `has_surface`.

    For `uniform` and `pool` all tissue pixels have the same weight, including the rim that Eq. (6) erodes.
    `released_prior`: tau_v rises with the brightness, and the percentile of Eq. (5) is that of the eroded mask.
    """
    if cfg.sampler != "prior":
        return (frame.tissue_mask & has_surface(frame)).astype(np.float64)
    tissue, threshold = frame.tissue_mask, VALUE_THRESHOLD
    if released_prior:
        tissue = eroded_mask(tissue)
        if tissue.any():
            threshold = max(threshold, float(np.percentile(frame.rgb.max(-1)[tissue], ADAPTIVE_PERCENTILE)))
    rho = joint_texture_prior(frame.rgb, tissue, value_threshold=threshold)
    probability = sampling_distribution(rho, frame.tissue_mask)
    if frame.weight is not None:
        probability = probability * frame.weight
    if frame.depth_confidence is not None:
        probability = probability * depth_weight(frame.depth_confidence)
    return np.where(has_surface(frame), probability, 0.0)


def sampling_distribution(
    rho: NDArray[np.floating], tissue_mask: NDArray[np.bool_], uniform: float = UNIFORM_FRACTION
) -> NDArray[np.float64]:
    """Sampling probability of each pixel: P, paper Eq. (6).

    Differs from the equation in two ways. rho is zero in the eroded rim, because the text of the paper excludes points
    at tool borders. The result is normalized exactly, which also makes it uniform if rho is zero everywhere.

    Args:
        rho: (H, W) joint texture prior in [0, 1]. uniform: eta_app.
    Returns:
        (H, W) probabilities that sum to 1; all 0 without tissue.
    Raises:
        ValueError: shapes differ, or rho is negative or not finite.
    """
    check_shape("rho:H,W tissue_mask:H,W", rho=rho, tissue_mask=tissue_mask)
    if rho.size and not (rho.min() >= 0 and np.isfinite(rho.max())):
        raise ValueError(f"rho must be finite and >= 0, got values from {rho.min()} to {rho.max()}")
    inside = eroded_mask(tissue_mask).astype(np.float64)
    structured = rho * inside
    probability = uniform * inside / (inside.sum() + EPSILON)
    probability += (1 - uniform) * structured / (structured.sum() + EPSILON)
    total = probability.sum()
    if total == 0:  # no texture and no uniform share: uniform; no tissue: 0
        probability, total = inside, inside.sum()
    return probability / total if total > 0 else probability


def eroded_mask(tissue_mask: NDArray[np.bool_], size_px: int | None = None) -> NDArray[np.bool_]:
    """The mask M eroded by an ellipse B_k of `size_px` (`EROSION_PX`), or M itself if nothing would be left."""
    size_px = EROSION_PX if size_px is None else size_px
    if size_px <= 1:
        return tissue_mask
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size_px, size_px))
    eroded = cv2.erode(tissue_mask.astype(np.uint8), element).astype(bool)
    return eroded if eroded.any() else tissue_mask


def quotas(budget: int, num_frames: int) -> list[int]:
    """Split a budget into equal shares; the first `budget % num_frames` frames get one more."""
    share, extra = divmod(budget, num_frames) if num_frames else (0, 0)
    return [share + (i < extra) for i in range(num_frames)]


def sample_pixels(weights: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Flat indices, ascending, of at most `count` pixels sampled without replacement by weights (H, W) >= 0.

    Gives pixel i the arrival time of a Poisson process of rate weights[i] and takes the earliest: the same
    distribution as sequential sampling, in one pass (Efraimidis and Spirakis, 2006).
    """
    candidates = np.flatnonzero(weights)
    arrival = rng.standard_exponential(len(candidates)) / weights.reshape(-1)[candidates]
    if count < len(candidates):
        candidates = candidates[np.argpartition(arrival, count)[:count]]
    return np.sort(candidates)


def initial_log_scales(points: NDArray[np.floating], variance_factor: float = 1.0) -> NDArray[np.float32]:
    """(N,) log standard deviation of isotropic Gaussians at points (N, 3), mm, from their 3 nearest neighbors.

    0.5 log(factor * max(mean of the 3 smallest squared distances, 1e-7 mm^2)); repeated points are at distance 0.

    Raises:
        ValueError: wrong shape, not finite, or fewer than 4 points.
    """
    check_shape("points:N,3", points=points)
    if len(points) < MIN_POINTS or not np.isfinite(points).all():
        raise ValueError(f"points must be at least {MIN_POINTS} finite points, got {len(points)}")
    # The nearest neighbor is the point itself or one that coincides with it: distance 0 either way.
    distance, _ = KDTree(points).query(points, k=MIN_POINTS)
    spacing = np.maximum((distance[:, 1:] ** 2).mean(1), MIN_SQUARED_SPACING)
    return (0.5 * np.log(variance_factor * spacing)).astype(np.float32)
