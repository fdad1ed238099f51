"""Where Gaussians start: pixels drawn from the prior (or evenly), lifted by their depth. Paper Eq. (6).

`H, W` image size, `N` points, `F` training frames, `B` budget. NumPy only.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.checks import InputError, check_shape
from ..core.config import InitConfig, PriorConfig
from ..core.geometry import FARTHEST_MM, back_project
from ..core.types import Frame
from ..priors import joint_texture_prior
from ..render.constants import NEAR_Z
from ..system.memory import workers
from .cleanup import PointCloud, joined, merge_voxels, remove_outliers

EPSILON = 1e-6
"""Keeps Eq. (6) finite where the mask or the prior is empty."""
MIN_SQUARED_SPACING = 1e-7
"""mm^2; initial scale of points that coincide, as EndoGaussian sets it."""
ADAPTIVE_PERCENTILE = 97.0
"""Percentile of brightness that raises tau_v under `adaptive_specular`."""
PRIOR_BYTES = 200
"""Per pixel, while the points of a frame are drawn."""
MIN_POINTS = 4
"""A scale needs three neighbors."""

log = logging.getLogger(__name__)


def initial_points(
    frames: Sequence[Frame], cfg: InitConfig | None = None, prior_cfg: PriorConfig | None = None, seed: int = 0
) -> PointCloud:
    """Sample about `cfg.budget` surface points from the training frames.

    `prior` and `uniform` give every frame the same share, without replacement; `pool` is EndoGaussian's: a share of
    each frame's tissue is pooled and the budget is drawn from the pool with replacement, so points repeat. Only
    pixels with measured depth are taken. A frame without enough of them gives what it has, and the log says so.

    Args:
        frames: F training frames (never test frames), each used once.
        cfg: sampler, budget, clean-up.
        prior_cfg: parameters of the prior.
        seed: equal seeds give equal points.
    Returns:
        At most B points in world axes; fewer after clean-up.
    Raises:
        InputError: fewer than 4 points are left.
    """
    cfg, prior_cfg = cfg or InitConfig(), prior_cfg or PriorConfig()
    shares = [None] * len(frames) if cfg.sampler == "pool" else quotas(cfg.budget, len(frames))

    def drawn(position: int) -> tuple[PointCloud, int]:
        rng = np.random.default_rng([seed, position])
        return _draw_points(frames[position], position, shares[position], cfg, prior_cfg, rng)

    threads = workers(PRIOR_BYTES * frames[0].tissue_mask.size) if len(frames) else 1
    with ThreadPoolExecutor(threads) as pool:  # NumPy and OpenCV release the interpreter lock
        found = list(pool.map(drawn, range(len(frames))))
    cloud, missing = joined([points for points, _ in found]), sum(missed for _, missed in found)
    if cfg.sampler == "pool" and len(cloud):
        cloud = cloud.taken(np.random.default_rng(seed).integers(len(cloud), size=cfg.budget))
    if cfg.cleanup:
        num_drawn = len(cloud)
        cloud = remove_outliers(merge_voxels(cloud, cfg.voxel_divisions), cfg.outlier_neighbors, cfg.outlier_std)
        log.info("initialization: %d of %d points left after clean-up", len(cloud), num_drawn)
    if len(cloud) < MIN_POINTS:
        raise InputError(
            f"initialization: expected at least {MIN_POINTS} tissue pixels with depth between {NEAR_Z:g} and "
            f"{FARTHEST_MM:g} mm in the training frames; got {len(cloud)}. Check masks, depth and its unit, and budget."
        )
    if missing:
        log.warning("initialization: %d of %d points could not be drawn, too few tissue pixels", missing, cfg.budget)
    return cloud


def has_surface(frame: Frame) -> NDArray[np.bool_]:
    """(H, W) True where depth was measured and a Gaussian there can be drawn: beyond the renderer's near plane.

    Depth in meters that passes for millimeters lies in front of it: nothing would ever be seen.
    """
    return frame.depth_valid & (frame.depth > NEAR_Z) & (frame.depth < FARTHEST_MM)


def _draw_points(
    frame: Frame, position: int, count: int | None, cfg: InitConfig, prior_cfg: PriorConfig, rng: np.random.Generator
) -> tuple[PointCloud, int]:
    """`count` points of one frame (None: the share of its pixels that is pooled), and how many it could not give."""
    probability = pixel_probability(frame, cfg, prior_cfg)
    available = int(np.count_nonzero(probability))
    if count is None:
        count = min(available, max(1, int(cfg.pool_fraction * available)))
    return _lift(frame, position, draw_pixels(probability, count, rng), cfg), max(0, count - available)


def pixel_probability(frame: Frame, cfg: InitConfig, prior_cfg: PriorConfig) -> NDArray[np.float64]:
    """(H, W) weight >= 0 with which the sampler named by `cfg` draws each pixel; 0 without tissue or `has_surface`.

    For `uniform` and `pool` every tissue pixel weighs the same, the rim that Eq. (6) erodes included.
    """
    if cfg.sampler != "prior":
        return (frame.tissue_mask & has_surface(frame)).astype(np.float64)
    eroded = eroded_mask(frame.tissue_mask, cfg.erosion_px)
    if cfg.adaptive_specular and eroded.any():
        bright = float(np.percentile(frame.rgb.max(-1)[eroded], ADAPTIVE_PERCENTILE))
        threshold = max(prior_cfg.specular.value_threshold, bright)
        prior_cfg = replace(prior_cfg, specular=replace(prior_cfg.specular, value_threshold=threshold))
    rho = joint_texture_prior(frame.rgb, eroded if cfg.salience_on_eroded_mask else frame.tissue_mask, prior_cfg)
    return np.where(has_surface(frame), sampling_distribution(rho, frame.tissue_mask, cfg), 0.0)


def sampling_distribution(
    rho: NDArray[np.floating], tissue_mask: NDArray[np.bool_], cfg: InitConfig | None = None
) -> NDArray[np.float64]:
    """Probability of drawing each pixel: P, paper Eq. (6).

    Differs from the equation in two ways: rho is zeroed in the eroded rim, since the text wants no point at a tool's
    border; and the result is normalized exactly, which also makes it uniform where rho is zero everywhere.

    Args:
        rho: (H, W) joint texture prior in [0, 1].
        tissue_mask: (H, W) True on tissue.
        cfg: eta_app and the size of the erosion.
    Returns:
        (H, W) probabilities that sum to 1; all 0 when there is no tissue.
    Raises:
        ValueError: shapes differ, or rho is negative or not finite.
    """
    cfg = cfg or InitConfig()
    check_shape("rho:H,W tissue_mask:H,W", rho=rho, tissue_mask=tissue_mask)
    if rho.size and not (rho.min() >= 0 and np.isfinite(rho.max())):
        raise ValueError(f"rho must be finite and >= 0; got values from {rho.min()} to {rho.max()}. Recompute it.")
    inside = eroded_mask(tissue_mask, cfg.erosion_px).astype(np.float64)
    structured = rho * inside
    probability = cfg.uniform_fraction * inside / (inside.sum() + EPSILON)
    probability += (1 - cfg.uniform_fraction) * structured / (structured.sum() + EPSILON)
    total = probability.sum()
    if total == 0:  # no texture and no uniform share: spread evenly; no tissue: stay 0
        probability, total = inside, inside.sum()
    return probability / total if total > 0 else probability


def eroded_mask(tissue_mask: NDArray[np.bool_], size_px: int) -> NDArray[np.bool_]:
    """Tissue whose whole `size_px` x `size_px` elliptical surrounding is tissue: M eroded by B_k.

    The outside of the image does not erode. Falls back to the mask itself where nothing would be left.
    """
    if size_px <= 1:
        return tissue_mask
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size_px, size_px))
    eroded = cv2.erode(tissue_mask.astype(np.uint8), element).astype(bool)
    return eroded if eroded.any() else tissue_mask


def quotas(budget: int, num_frames: int) -> list[int]:
    """Split a budget into equal shares; the first `budget % num_frames` frames get one more."""
    share, extra = divmod(budget, num_frames) if num_frames else (0, 0)
    return [share + (i < extra) for i in range(num_frames)]


def draw_pixels(weights: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw pixels one after the other without replacement, each with probability proportional to its weight.

    Gives pixel i the arrival time of a Poisson process of rate weights[i] and takes the earliest: the same
    distribution as drawing in turn, in one pass (Efraimidis and Spirakis, 2006).

    Args:
        weights: (H, W) weights >= 0; zeros are never drawn.
        count: how many.
        rng: source of randomness.
    Returns:
        (min(count, non-zero weights),) flat indices, ascending.
    """
    candidates = np.flatnonzero(weights)
    arrival = rng.standard_exponential(len(candidates)) / weights.reshape(-1)[candidates]
    if count < len(candidates):
        candidates = candidates[np.argpartition(arrival, count)[:count]]
    return np.sort(candidates)


def initial_log_scales(points: NDArray[np.floating], variance_factor: float = 1.0) -> NDArray[np.float32]:
    """Log standard deviation of isotropic Gaussians that fill the space between the points.

    Args:
        points: (N, 3) centers, mm; repeated points count as neighbors at distance 0.
        variance_factor: multiplies the mean squared distance.
    Returns:
        (N,) 0.5 log(factor * max(mean of the 3 smallest squared distances, 1e-7 mm^2)).
    Raises:
        ValueError: wrong shape, not finite, or fewer than 4 points.
    """
    check_shape("points:N,3", points=points)
    if len(points) < MIN_POINTS or not np.isfinite(points).all():
        raise ValueError(f"points must be at least {MIN_POINTS} finite points; got {len(points)}. Check the cloud.")
    # The nearest point found is the point itself, or one that coincides with it: distance 0 either way.
    distance, _ = cKDTree(points).query(points, k=MIN_POINTS)
    spacing = np.maximum((distance[:, 1:] ** 2).mean(1), MIN_SQUARED_SPACING)
    return (0.5 * np.log(variance_factor * spacing)).astype(np.float32)


def _lift(frame: Frame, position: int, flat: NDArray[np.intp], cfg: InitConfig) -> PointCloud:
    """World points and colors of pixels given by flat index, in the frame at `position`."""
    v, u = np.divmod(flat, frame.camera.width)
    offset = 0.5 if cfg.pixel_offset == "exact" else 0.0
    pixels = np.stack([u, v], -1) + offset
    points = back_project(pixels, frame.depth[v, u].astype(np.float64), frame.camera)
    colors = frame.rgb_u8[v, u].astype(np.float32) / np.float32(255)
    return PointCloud(points.astype(np.float32), colors, np.full(len(points), position, np.int32))
