"""Initialize the motion: track surface points by optical flow and depth, and fit temporal coefficients.

Coefficients that start at zero learn motion from color alone, whose gradient reaches only a few pixels. Tissue that
moves farther between frames is then explained by Gaussians that fade in and out. Tracking each point by dense inverse
search (Kroeger et al. 2016, OpenCV) provides an initial motion, which training refines.

Shared letters: `T` training frames, `N` points, `B` basis functions.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.config import BasisConfig
from ..core.geometry import back_project, bilinear, project
from ..core.types import Camera, Frame
from ..footage.optical_flow import (
    FLOW_BYTES,
    MIN_SIZE_PX,
    RETURN_PX,
    RETURN_SHARE,
    FlowPair,
    flow_pair,
    gray_for_flow,
)
from ..model.basis import basis_weights
from ..system.memory import BoundedCache, cache_bytes, workers
from . import track_kernels as kernels
from .cleanup import PointCloud
from .sampling import has_surface

STATIC_MARGIN = 1.1
"""A point is static if its color error at the static position is at most this factor times that along its track."""
BLUR_PX = 1.5
"""Standard deviation of the blur before colors are compared."""
FLOW_CHUNK = 16
"""Number of frame pairs whose flow is computed and cached together."""
RIDGE = 1e-2
"""Ridge term of the least-squares fit of coefficients to tracks; each frame has weight 1."""

log = logging.getLogger(__name__)


def initial_motion(frames: Sequence[Frame], cloud: PointCloud, cfg: BasisConfig) -> NDArray[np.float32]:
    """Temporal coefficients that move every point of the cloud along its track.

    Args:
        frames: T training frames (never test frames), in order.
        cloud: points with their source frames.
    Returns:
        (N, B, 3) coefficients of the centers, mm; 0 for frames too small for optical flow.
    """
    height, width = frames[0].tissue_mask.shape
    if min(height, width) < MIN_SIZE_PX:
        log.warning("initial motion: frames of %d x %d px are too small for optical flow", width, height)
        return np.zeros((len(cloud), cfg.num_bases, 3), np.float32)
    points = cloud.points.astype(np.float64)
    pixels = track_points(frames, points, cloud.origins)
    moving = ~is_static(frames, points, cloud.origins, pixels)
    log.info("initial motion: %d of %d points move", moving.sum(), len(cloud))
    offsets = lift(frames, pixels[:, moving]) - points[moving]
    kernels.fill_gaps(offsets)
    motion = np.zeros((len(cloud), cfg.num_bases, 3), np.float32)
    motion[moving] = fit_basis(offsets, [frame.time for frame in frames], cfg)
    return motion


def track_points(frames: Sequence[Frame], points: NDArray, origins: NDArray[np.integer]) -> NDArray[np.float64]:
    """Pixels of each point in every frame, by chaining optical flow from its source frame in both directions.

    A track ends where the point leaves the image or the tissue, or where backward flow does not return to it.

    Args:
        points: (N, 3) world, mm. origins: (N,) positions of their source frames in `frames`.
    Returns:
        (T, N, 2) px; NaN where a point is lost.
    """
    pixels = np.full((len(frames), len(points), 2), np.nan)
    for position in np.unique(origins):
        own = origins == position
        pixels[position, own] = project(points[own], frames[position].camera)[0]
    flow, limits = _flows(frames), (RETURN_PX, RETURN_SHARE)
    for k in range(len(frames) - 1):
        kernels.advance(pixels[k], origins <= k, *flow(k), frames[k + 1].tissue_mask, *limits, pixels[k + 1])
    for k in range(len(frames) - 1, 0, -1):
        forward, backward = flow(k - 1)
        kernels.advance(pixels[k], origins >= k, backward, forward, frames[k - 1].tissue_mask, *limits, pixels[k - 1])
    return pixels


def _flows(frames: Sequence[Frame]) -> Callable[[int], FlowPair]:
    """A function that returns the flows between frames k and k + 1; it caches as many as memory allows."""
    height, width = frames[0].tissue_mask.shape

    def chunk(number: int) -> list[FlowPair]:
        first = number * FLOW_CHUNK
        grays = [gray_for_flow(frames[k].rgb_u8) for k in range(first, min(first + FLOW_CHUNK + 1, len(frames)))]
        with ThreadPoolExecutor(workers(FLOW_BYTES * width * height)) as pool:  # OpenCV releases the interpreter lock
            return list(pool.map(flow_pair, grays[:-1], grays[1:]))

    cache: BoundedCache[list[FlowPair]] = BoundedCache(
        cache_bytes(), lambda pairs: sum(flow.nbytes for pair in pairs for flow in pair)
    )
    return lambda k: cache.get(k // FLOW_CHUNK, lambda: chunk(k // FLOW_CHUNK))[k % FLOW_CHUNK]


def is_static(
    frames: Sequence[Frame], points: NDArray, origins: NDArray[np.integer], pixels: NDArray
) -> NDArray[np.bool_]:
    """(N,) whether a static point matches the frames as well as its track does.

    Chained flow drifts and depth jitters, so without motion the static position is the better estimate.

    Args:
        points: (N, 3) world, mm. origins: (N,) positions in `frames`. pixels: (T, N, 2) from `track_points`.
    """

    def blurred(position: int) -> NDArray[np.uint8]:
        return cv2.GaussianBlur(cv2.cvtColor(frames[position].rgb_u8, cv2.COLOR_RGB2GRAY), (0, 0), BLUR_PX)

    own_gray, along_track, if_static = np.zeros((3, len(points)))
    for position in np.unique(origins):
        own = origins == position
        own_gray[own] = bilinear(blurred(position), pixels[position, own])
    for position in range(len(frames)):
        image = blurred(position)
        static = _project_in_front(points, frames[position].camera)
        kernels.add_mismatch(image, pixels[position], origins != position, static, own_gray, along_track, if_static)
    return if_static <= STATIC_MARGIN * along_track


def _project_in_front(points: NDArray, camera: Camera) -> NDArray[np.float64]:
    """Pixels (M, 2) of world points; far outside the image for those behind the camera."""
    pixels, z = project(points, camera)
    return np.where((z > 0)[:, None], pixels, -1e6)


def lift(frames: Sequence[Frame], pixels: NDArray) -> NDArray[np.float64]:
    """Back-project pixels (T, N, 2) to world points (T, N, 3), mm; NaN without a pixel or measured depth."""
    found = np.full((*pixels.shape[:2], 3), np.nan)
    for position, frame in enumerate(frames):
        known = np.flatnonzero(np.isfinite(pixels[position, :, 0]))
        height, width = frame.tissue_mask.shape
        x, y = _nearest(pixels[position, known], width, height)
        measured = has_surface(frame)[y, x]
        depth = frame.depth[y, x].astype(np.float64)[measured]
        found[position, known[measured]] = back_project(pixels[position, known[measured]], depth, frame.camera)
    return found


def _nearest(pixels: NDArray, width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Column and row of the pixel at each position, clamped to the image."""
    x, y = np.floor(pixels).astype(np.intp).T
    return np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)


def fit_basis(offsets: NDArray[np.float64], times: list[float], cfg: BasisConfig) -> NDArray[np.float32]:
    """Least-squares coefficients (N, B, 3) of offsets (T, N, 3) mm at T `times` in [0, 1]."""
    weights = np.stack([basis_weights(time, cfg) for time in times])
    normal = weights.T @ weights + RIDGE * np.eye(cfg.num_bases)
    solve = np.linalg.solve(normal, weights.T)
    fitted = solve @ offsets.reshape(len(times), -1)
    return np.ascontiguousarray(fitted.reshape(cfg.num_bases, -1, 3).transpose(1, 0, 2), np.float32)
