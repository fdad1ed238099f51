"""Initialize the motion: track surface points by optical flow and depth, and fit temporal coefficients.

Coefficients that start at zero learn motion from color alone, whose gradient reaches only a few pixels. Tissue that
moves farther between frames is then explained by Gaussians that fade in and out. Tracking each point by dense inverse
search (Kroeger et al. 2016, OpenCV) provides an initial motion, which training refines.

A point goes from its source frame to an anchor, and from there to every other frame: two steps of flow, each checked by
the flow back. Of all anchors, the one counts whose two steps close best. Where none closes, the point is lost, and
moves as the points around it do (`neighbor_motion`).

Shared letters: `T` training frames, `N` points, `B` basis functions.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.config_deformation import BasisConfig
from ..core.geometry import back_project, cells_at, project
from ..core.types import Frame
from ..footage.optical_flow import MIN_SIZE_PX, fine_shrink, gray_for_flow
from ..model.basis import basis_weights
from ..system.memory import workers
from . import track_kernels as kernels
from .anchor_flow import REACH, AnchorFlow, anchor_flow, anchors, neighbor_flows
from .cleanup import PointCloud
from .neighbor_motion import fill_gaps, smooth_motion
from .sampling import has_surface

CYCLE_PX = 0.25
"""A point is lost where forward and backward flow of its two steps disagree by more than this, px of the flow."""
ANCHOR_BYTES = 8 * (2 * REACH + 1)
"""Memory per pixel of the flows of one anchor, bytes."""
RIDGE = 1e-5
"""Ridge term of the least-squares fit of coefficients to tracks; each frame has weight 1."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class InitialMotion:
    """How N points move, and in which of T training frames the flow says so."""

    coefficients: NDArray[np.float32]
    """(N, B, 3) temporal coefficients of the centers, mm."""
    followed: NDArray[np.bool_]
    """(N, T) True where the flow found the point and returned to it; elsewhere its neighbors carried it."""

    def joined(self, coefficients: NDArray[np.float32]) -> InitialMotion:
        """This motion and that of further points, (M, B, 3) mm, which the flow never found."""
        never = np.zeros((len(coefficients), self.followed.shape[1]), bool)
        return InitialMotion(np.concatenate([self.coefficients, coefficients]), np.concatenate([self.followed, never]))


def initial_motion(frames: Sequence[Frame], cloud: PointCloud, cfg: BasisConfig) -> InitialMotion:
    """Temporal coefficients that move every point of the cloud along its track.

    Args:
        frames: T training frames (never test frames), in order.
        cloud: points with their source frames.
    Returns:
        The motion; none at all for frames too small for optical flow.
    """
    height, width = frames[0].tissue_mask.shape
    if min(height, width) < MIN_SIZE_PX:
        log.warning("initial motion: frames of %d x %d px are too small for optical flow", width, height)
        nowhere = np.zeros((len(cloud), len(frames)), bool)
        return InitialMotion(np.zeros((len(cloud), cfg.num_bases, 3), np.float32), nowhere)
    positions = lift(frames, track_points(frames, cloud.points.astype(np.float64), cloud.origins))
    followed = np.isfinite(positions[..., 0]).T.copy()
    log.info("initial motion: points are followed in %.0f %% of the frames", 100 * followed.mean())
    positions[cloud.origins, np.arange(len(cloud))] = cloud.points
    offsets = smooth_motion(fill_gaps(positions), cloud.origins)
    return InitialMotion(fit_basis(offsets, [frame.time for frame in frames], cfg), followed)


def track_points(frames: Sequence[Frame], points: NDArray, origins: NDArray[np.integer]) -> NDArray[np.float32]:
    """Pixels of each point in every frame.

    Args:
        points: (N, 3) world, mm. origins: (N,) positions of their source frames in `frames`.
    Returns:
        (T, N, 2) px; NaN where a point is lost: outside of the image or the tissue, or where flow does not return.
    """
    masks = [frame.tissue_mask for frame in frames]
    shrink = fine_shrink(*masks[0].shape)
    grays = [gray_for_flow(frame.rgb_u8, shrink) for frame in frames]
    sources = np.empty((len(points), 2))
    for position in np.unique(origins):
        sources[origins == position] = project(points[origins == position], frames[position].camera)[0]
    pixels = np.full((len(frames), len(points), 2), np.nan, np.float32)
    error = np.full(pixels.shape[:2], np.inf, np.float32)
    # OpenCV releases the interpreter lock; an anchor needs the flows to all frames that it reaches.
    with ThreadPoolExecutor(workers(ANCHOR_BYTES * grays[0].size)) as pool:
        neighbors = list(pool.map(lambda k: neighbor_flows(grays, k), range(len(frames) - 1)))
        for flow in pool.map(lambda anchor: anchor_flow(grays, neighbors, anchor), anchors(len(frames))):
            _add_tracks(flow, masks, sources, origins, CYCLE_PX * shrink, pixels, error)
    pixels[origins, np.arange(len(points))] = sources
    return pixels


def _add_tracks(
    flow: AnchorFlow,
    masks: Sequence[NDArray[np.bool_]],
    sources: NDArray[np.float64],
    origins: NDArray[np.integer],
    limit_px: float,
    pixels: NDArray[np.float32],
    error: NDArray[np.float32],
) -> None:
    """Follow all points by way of one anchor; update `pixels` (T, N, 2) where the `error` (T, N), px, gets smaller.

    Args:
        masks: (H, W) tissue of each frame. sources: (N, 2) px in the frames `origins` (N,).
    """
    at_anchor, first_step = np.full_like(sources, np.nan), np.full(len(sources), np.inf)
    for t in flow.there:
        own = np.flatnonzero(origins == t)
        at_anchor[own], first_step[own] = _followed(sources[own], flow.back[t], flow.there[t], masks[flow.anchor])
    near = np.flatnonzero(first_step <= limit_px)
    for t in flow.there:
        end, second_step = _followed(at_anchor[near], flow.there[t], flow.back[t], masks[t])
        both = first_step[near] + second_step
        better = (both < error[t, near]) & (both <= limit_px)
        error[t, near[better]], pixels[t, near[better]] = both[better], end[better]


def _followed(
    pixels: NDArray[np.float64], there: NDArray[np.float16], back: NDArray[np.float16], mask: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) after one step, and by how much the step back misses (N,), px; infinite off the tissue `mask`."""
    end, cycle_px = np.empty_like(pixels), np.empty(len(pixels))
    kernels.follow(pixels, there.astype(np.float32), back.astype(np.float32), mask, end, cycle_px)
    return end, cycle_px


def lift(frames: Sequence[Frame], pixels: NDArray) -> NDArray[np.float32]:
    """Back-project pixels (T, N, 2) to world points (T, N, 3), mm; NaN without a pixel or measured depth."""
    found = np.full((*pixels.shape[:2], 3), np.nan, np.float32)
    for position, frame in enumerate(frames):
        known = np.flatnonzero(np.isfinite(pixels[position, :, 0]))
        height, width = frame.tissue_mask.shape
        x, y = cells_at(pixels[position, known], width, height)
        measured = has_surface(frame)[y, x]
        depth = frame.depth[y, x].astype(np.float64)[measured]
        found[position, known[measured]] = back_project(pixels[position, known[measured]], depth, frame.camera)
    return found


def fit_basis(offsets: NDArray[np.floating], times: list[float], cfg: BasisConfig) -> NDArray[np.float32]:
    """Least-squares coefficients (N, B, 3) of offsets (T, N, 3) mm at T `times` in [0, 1]."""
    weights = np.stack([basis_weights(time, cfg) for time in times])
    normal = weights.T @ weights + RIDGE * np.eye(cfg.num_bases)
    solve = np.linalg.solve(normal, weights.T)
    fitted = solve @ offsets.reshape(len(times), -1)
    return np.ascontiguousarray(fitted.reshape(cfg.num_bases, -1, 3).transpose(1, 0, 2), np.float32)
