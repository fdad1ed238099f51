"""Initialize the motion: track surface points by optical flow and depth, and fit temporal coefficients.

Coefficients that start at zero learn motion from color alone, whose gradient reaches only a few pixels. Tissue that
moves farther between frames is then explained by Gaussians that fade in and out. Tracking each point by dense inverse
search (Kroeger et al. 2016, OpenCV) provides an initial motion, which training refines.

Chained from frame to frame, flow drifts. The flow straight from an anchor frame to a distant frame does not; it is
found because its search starts from the flow to the frame between. A point goes from its source frame to an anchor, and
from there to every other frame: two steps of flow, each checked by the flow back. Of all anchors, the one counts whose
two steps close best. Where none closes, or a point stays in the image although the camera moves (fixed to a border or
to fibers), it is lost, and moves as the points around it do (`neighbor_motion`).

`T` training frames, `N` points, `B` basis functions, `h, w` size of the gray images. Pixels are float64 with centers at
half integers.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..compute.parallel_kernels import parallel_njit
from ..core.config_deformation import BasisConfig
from ..core.geometry import back_project, cells_at, project
from ..core.types import Frame
from ..footage.optical_flow import MIN_SIZE_PX, fine_flow, fine_shrink, fixed_in_image, gray_for_flow
from ..system.memory import workers
from .motion_fit import InitialMotion, fit_motion
from .neighbor_motion import fill_gaps, smooth_motion
from .sampling import PointCloud, has_surface

SPACING = 14  # largest number of frames between two anchors. With 6 the tracks of the phantoms are no better.
MIN_ANCHORS = 4  # also of a short sequence: a point that is hidden in one anchor is followed by way of another
REACH = 48  # frames to both sides of an anchor to which flow is computed
CYCLE_PX, CYCLE_SHARE = (0.25, 0.6), 0.5
"""A point is lost where forward and backward flow of its two steps disagree by more than a limit, px of the flow: that
which keeps this share of all points and frames, within these bounds. Poor images close worse, and the few of their
points that close well are too few to carry the rest."""
ANCHOR_BYTES = 8 * (2 * REACH + 1)  # memory per pixel of the flows of one anchor, bytes
Flow = NDArray[np.float16]
"""(h, w, 2) px of the gray images. Half precision: 0.01 px at 30 px, and all flows of an anchor fit in memory."""

log = logging.getLogger(__name__)


def initial_motion(frames: Sequence[Frame], cloud: PointCloud, cfg: BasisConfig) -> InitialMotion:
    """How every point of the cloud moves along its track; not at all in frames too small for optical flow.

    Args:
        frames: T training frames (never test frames), in order.
        cloud: N points with their source frames. cfg: how many spline functions there are.
    """
    height, width = frames[0].tissue_mask.shape
    if min(height, width) < MIN_SIZE_PX:
        log.warning("initial motion: frames of %d x %d px are too small for optical flow", width, height)
        coefficients, at_frames = (np.zeros((len(cloud), n, 3), np.float32) for n in (cfg.num_bases, len(frames)))
        return InitialMotion(coefficients, at_frames, np.zeros((len(cloud), len(frames)), bool))
    positions = lift(frames, track_points(frames, cloud.points.astype(np.float64), cloud.origins))
    followed = np.isfinite(positions[..., 0]).T.copy()
    log.info("initial motion: points are followed in %.0f %% of the frames", 100 * followed.mean())
    positions[cloud.origins, np.arange(len(cloud))] = cloud.points
    offsets = smooth_motion(fill_gaps(positions), cloud.origins)
    rays = cloud.points - np.stack([frame.camera.center for frame in frames])[cloud.origins]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return InitialMotion(*fit_motion(offsets, rays, [frame.time for frame in frames], cfg), followed)


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
            _add_tracks(flow, masks, sources, origins, CYCLE_PX[1] * shrink, pixels, error)
    pixels[error > cycle_limit_px(error / shrink) * shrink] = np.nan
    for t, frame in enumerate(frames):
        rigid, _ = project(points, frame.camera)
        pixels[t, fixed_in_image(pixels[t] - sources, rigid - sources, masks[t].shape[1])] = np.nan
    pixels[origins, np.arange(len(points))] = sources
    return pixels


def cycle_limit_px(error_px: NDArray[np.floating]) -> float:
    """The largest error with which a point is not lost, px of the flow, within `CYCLE_PX`.

    Args:
        error_px: (T, N) px of the flow by which points miss their start; infinite where no anchor leads.
    """
    middle = int(CYCLE_SHARE * error_px.size)
    return float(np.clip(np.partition(error_px.ravel(), middle)[middle], *CYCLE_PX))


def anchors(count: int) -> list[int]:
    """Positions of the anchors among `count` frames: the middles of equal parts of at most `SPACING` frames."""
    parts = max(-(-count // SPACING), min(count, MIN_ANCHORS))
    return [int((i + 0.5) * count / parts) for i in range(parts)]


def neighbor_flows(grays: Sequence[NDArray[np.uint8]], k: int) -> tuple[Flow, Flow]:
    """Flow from image `k` to the next one, and back."""
    first, second = grays[k], grays[k + 1]
    return fine_flow(first, second).astype(np.float16), fine_flow(second, first).astype(np.float16)


class AnchorFlow(NamedTuple):
    """The flows between one anchor and the frames around it, by frame."""

    anchor: int
    there: dict[int, Flow]
    back: dict[int, Flow]


def anchor_flow(grays: Sequence[NDArray[np.uint8]], neighbors: Sequence[tuple[Flow, Flow]], anchor: int) -> AnchorFlow:
    """The flows between image `anchor` and those up to `REACH` from it.

    Args:
        grays: T gray images. neighbors: T - 1 results of `neighbor_flows`.
    """
    still = np.zeros((*grays[0].shape, 2), np.float16)
    there, back = {anchor: still}, {anchor: still}
    for last, step in ((min(anchor + REACH, len(grays) - 1), 1), (max(anchor - REACH, 0), -1)):
        for k in range(anchor, last, step):
            onward, returning = neighbors[k] if step > 0 else neighbors[k - 1][::-1]
            guess_there, guess_back = _composed(there[k], onward), _composed(returning, back[k])
            there[k + step] = fine_flow(grays[anchor], grays[k + step], guess_there).astype(np.float16)
            back[k + step] = fine_flow(grays[k + step], grays[anchor], guess_back).astype(np.float16)
    return AnchorFlow(anchor, there, back)


def _composed(first: Flow, second: Flow) -> NDArray[np.float32]:
    """(h, w, 2) flow that goes along `first` and from there along `second`."""
    start, row_column = first.astype(np.float32), np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    x, y = row_column[1] + start[..., 0], row_column[0] + start[..., 1]
    return start + cv2.remap(second.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _add_tracks(
    flow: AnchorFlow,
    tissue_masks: Sequence[NDArray[np.bool_]],
    sources: NDArray[np.float64],
    origins: NDArray[np.integer],
    limit_px: float,
    pixels: NDArray[np.float32],
    error: NDArray[np.float32],
) -> None:
    """Follow all points by way of one anchor; update `pixels` (T, N, 2) where the `error` (T, N), px, gets smaller.

    Args:
        tissue_masks: (H, W) tissue of each frame. sources: (N, 2) px in the frames `origins` (N,).
    """

    def followed(points: NDArray, there: Flow, back: Flow, frame: int) -> tuple[NDArray, NDArray]:
        return follow(points, there.astype(np.float32), back.astype(np.float32), tissue_masks[frame])

    there, back = flow.there, flow.back
    at_anchor, first_step = np.full_like(sources, np.nan), np.full(len(sources), np.inf)
    for t in there:
        own = np.flatnonzero(origins == t)
        at_anchor[own], first_step[own] = followed(sources[own], back[t], there[t], flow.anchor)
    near = np.flatnonzero(first_step <= limit_px)
    for t in there:
        end, second_step = followed(at_anchor[near], there[t], back[t], t)
        both = first_step[near] + second_step
        better = (both < error[t, near]) & (both <= limit_px)
        error[t, near[better]], pixels[t, near[better]] = both[better], end[better]


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


@parallel_njit()
def follow(pixels, there, back, tissue_mask):
    # Where pixels (N, 2) get to along the flow `there` (h, w, 2), and by how much `back` misses their start, (N,) px:
    # infinite where the point leaves the image or the tissue (H, W). Flow is in px of its own size, all else in px of
    # the mask.
    height, width = tissue_mask.shape
    scale_x, scale_y = width / there.shape[1], height / there.shape[0]
    end, cycle_px = np.empty_like(pixels), np.full(len(pixels), np.inf)
    for n in prange(len(pixels)):
        x, y = pixels[n]
        step_x, step_y = _flow(there, x / scale_x, y / scale_y)
        x, y = x + step_x * scale_x, y + step_y * scale_y
        end[n, 0], end[n, 1] = x, y
        if 0 <= x <= width and 0 <= y <= height and tissue_mask[min(int(y), height - 1), min(int(x), width - 1)]:
            back_x, back_y = _flow(back, x / scale_x, y / scale_y)
            cycle_px[n] = np.hypot((step_x + back_x) * scale_x, (step_y + back_y) * scale_y)
    return end, cycle_px


@njit(inline="always")
def _flow(flow, x, y):
    # Bilinear, as in `geometry.bilinear`; outside of the image, the border value is repeated.
    height, width = flow.shape[:2]
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    column, row = int(u), int(v)
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    fx, fy = u - column, v - row
    x = y = 0.0
    for i, j, weight in (
        (row, column, (1 - fx) * (1 - fy)),
        (row, right, fx * (1 - fy)),
        (below, column, (1 - fx) * fy),
        (below, right, fx * fy),
    ):
        x, y = x + weight * flow[i, j, 0], y + weight * flow[i, j, 1]
    return x, y
