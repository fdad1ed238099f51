"""A second look at the path: cameras and lens are adjusted to direct matches of frames with parallax.

Tracks go from frame to frame and their errors add up; of depth by parallax they are most of the error. Direct matches
remove that where the scene is rigid. Where tissue moves by itself they fit no camera, and the path stays as it is.

A match is a corner of a frame, found again in a partner with no frame between them: the partner is warped into the
frame by depth and the path so far, and what is left is an optical flow of few pixels (Lucas and Kanade 1981). `N`
corners.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...footage.keypoints import track_forward_backward
from ...system.memory import BoundedCache, cache_bytes
from ...system.parallel import frame_threads
from .adjust import Adjusted, Observations, adjust, back_projected, residuals
from .path import CameraPath
from .tracks import FrameReader, PoseInput, TrackingCamera
from .views import HighPassImage, Warp, choose_partners, matrix_at, scaled_size

MAX_WIDTH = 640  # frames are matched at this width at most, px
PIXEL_STD = 0.3  # of a match, px of an image 640 px wide
DEPTH_STD = 0.2  # of the depth so far, as a share of it: it holds the scale of the path
FOCAL_PRIOR, FOCAL_STD = 0.2, 0.03  # of log f where it is assumed; a refined one is kept if it is known this well
MIN_OBSERVATIONS = 30  # observations of a camera; with fewer it moves along with the nearest one that has more
SEEN_IN = 3  # frames that see a corner by which the fit is measured
FITS_PX = 0.5  # three quarters of the matches of a rigid scene are within this, px of an image 640 px wide
RIGID = 0.5  # weight of a corner that follows the rigid scene
CORNERS, MIN_IN_FRAME, MAX_IN_FRAME = 6000, 30, 150  # of all frames; at least and at most of one
QUALITY, APART = 0.01, 1 / 60  # of a corner, to the best one; distance to the next, as a share of the width
INNER_PX = 4  # corners and matches keep so far from what is not usable
WINDOW_PX, LEVELS = 21, 1  # of the optical flow
STOP = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005
MAX_BACK_PX, MAX_SHIFT_PX = 0.5, 8.0  # a match leads back to its corner, and is near where the path expects it
CONTRAST = 2.5  # standard deviations of the detail that the flow tells apart
BYTES_PER_PX = 100  # memory in which a thread matches a frame


@dataclass(frozen=True)
class Refined:
    """A path that is adjusted to direct matches."""

    path: CameraPath
    residual_px: float  # three quarters of the matches are within it, px of an image 640 px wide

    @property
    def fits(self) -> bool:
        """Whether the scene is rigid, so that the path is better than before."""
        return self.residual_px < FITS_PX


def refined_path(path: CameraPath, frames: FrameReader, camera: TrackingCamera) -> Refined | None:
    """Adjust a path to direct matches; None where too few frames have parallax.

    Args:
        frames: with depth in the unit of the path.
        camera: before any refinement of the focal length.
    """
    small = scaled_size(camera.size, MAX_WIDTH)
    matrix = matrix_at(camera.with_focal(path.focal_factor).matrix, camera.size, small)
    px, focal_prior = small[0] / 640, FOCAL_PRIOR if camera.focal_is_assumed else 0.0
    poses = np.linalg.inv(path.camera_to_world)
    # Frames of one pose, in which the camera rests, are one camera.
    _, first, station = np.unique(poses.reshape(len(poses), -1), axis=0, return_index=True, return_inverse=True)
    station, stations = station.ravel(), poses[first]
    matches = list(match_frames(frames, poses, path.explained, matrix, small))
    seen, points, known = _observations(matches, poses, station, matrix, px)
    if known.sum() < 2:
        return None
    fixed = np.arange(len(stations)) == station[np.flatnonzero(known[station])[0]]
    found = adjust(matrix, stations, points, seen, fixed, focal_prior=focal_prior, steps=3)
    if found.focal_std > FOCAL_STD:  # the matches do not determine it
        found = adjust(matrix, stations, points, seen, fixed, steps=3)
    if not (np.isfinite(found.poses).all() and np.isfinite(found.points).all()):
        return None
    new = _with_the_rest(stations, found.poses, known, first)[station]
    new = new @ np.linalg.inv(new[0])  # the first frame is at the origin
    scales = path.depth_scale * _scales(found, seen, len(stations))[station]
    focal = path.focal_factor * found.focal_factor
    done = replace(path, camera_to_world=np.linalg.inv(new), focal_factor=focal, depth_scale=scales)
    return Refined(done, PIXEL_STD * _residual(matrix, found, seen))


def _observations(
    matches: list[Matches | None], poses: NDArray, camera: NDArray, matrix: NDArray, px: float
) -> tuple[Observations, NDArray, NDArray[np.bool_]]:
    """What the cameras see of all corners that another camera sees, too; the corners (P, 3) in the world; and which
    cameras see enough.

    Args:
        poses: (T, 4, 4) world to camera. camera: (T,) of each frame.
        px: length of a pixel of an image 640 px wide, px.
    """
    cameras, corners, pixels, depths, points, count = [], [], [], [], [], 0
    for i, found in enumerate(matches):
        if found is None:
            continue
        there = np.isfinite(found.seen[..., 0])
        kept = np.flatnonzero(there.any(0))
        own, ids = found.pixels[kept].astype(np.float64), count + np.arange(len(kept))
        points.append(back_projected(matrix, poses[i], own, found.depth[kept].astype(np.float64)))
        cameras.append(np.full(len(kept), camera[i]))
        corners.append(ids)
        pixels.append(own)
        depths.append(found.depth[kept])
        for j, seen, sees in zip(found.partners, found.seen[:, kept], there[:, kept], strict=True):
            cameras.append(np.full(int(sees.sum()), camera[j]))
            corners.append(ids[sees])
            pixels.append(seen[sees].astype(np.float64))
            depths.append(np.full(int(sees.sum()), np.inf))
        count += len(kept)
    if not count:
        return Observations(*np.zeros((5, 0))), np.zeros((0, 3)), np.zeros(camera.max() + 1, bool)
    inverse = 1 / np.concatenate(depths).astype(np.float64)
    sigma = np.stack([np.full(len(inverse), PIXEL_STD * px), np.where(inverse > 0, DEPTH_STD * inverse, np.inf)], 1)
    seen = Observations(np.concatenate(cameras), np.concatenate(corners), np.concatenate(pixels), inverse, sigma)
    known = np.bincount(seen.camera, minlength=camera.max() + 1) >= MIN_OBSERVATIONS
    return seen, np.concatenate(points), known


def _with_the_rest(old: NDArray, new: NDArray, known: NDArray[np.bool_], first: NDArray) -> NDArray:
    """(K, 4, 4) adjusted poses, where cameras that are not known move along with the nearest known one in time.

    Args:
        old, new: (K, 4, 4) world to camera before and after. first: (K,) the first frame of each.
    """
    out, sure = new.copy(), np.flatnonzero(known)
    for k in np.flatnonzero(~known):
        near = sure[np.argmin(np.abs(first[sure] - first[k]))]
        out[k] = old[k] @ np.linalg.inv(old[near]) @ new[near]
    return out


def _scales(found: Adjusted, seen: Observations, count: int) -> NDArray[np.float64]:
    """(K,) factor from the depth so far to that of the adjusted corners, for each camera the median of its own."""
    own = np.flatnonzero((seen.inverse_depth > 0) & (found.track_weight[seen.point] > RIGID))
    poses, points = found.poses[seen.camera[own]], found.points[seen.point[own]]
    z = np.einsum("nj,nj->n", poses[:, 2, :3], points) + poses[:, 2, 3]
    ratio, camera = z * seen.inverse_depth[own], seen.camera[own]
    usual = float(np.median(ratio)) if len(own) else 1.0
    of_each = [ratio[camera == k] for k in range(count)]
    return np.array([np.median(each) if len(each) >= MIN_OBSERVATIONS else usual for each in of_each])


def _residual(matrix: NDArray, found: Adjusted, seen: Observations) -> float:
    """Three quarters of the residuals of corners that enough cameras see are within this, standard deviations."""
    adjusted = matrix.copy()
    adjusted[[0, 1], [0, 1]] *= found.focal_factor
    here = found.poses[seen.camera], found.points[seen.point], seen.pixels, seen.inverse_depth, seen.sigma
    error = np.linalg.norm(residuals(adjusted, *here)[:, :2], axis=1)
    counted = np.bincount(seen.point)[seen.point] >= SEEN_IN
    return float(np.quantile(error[counted], 0.75)) if counted.any() else np.inf


@dataclass(frozen=True)
class Matches:
    """Where other frames see the corners of one frame."""

    pixels: NDArray[np.float32]  # (N, 2) in the frame, px; the left-most pixel is centered at 0
    depth: NDArray[np.float32]  # (N,) that was assumed, in the unit of the path
    partners: tuple[int, ...]
    seen: NDArray[np.float32]  # (len(partners), N, 2) px; NaN where a partner does not see the corner


@dataclass(frozen=True)
class _Picture:
    """A frame as the flow reads it."""

    detail_u8: NDArray[np.uint8]  # (h, w)
    inner: NDArray[np.uint8]  # (h, w) 255 well inside of what is usable, else 0
    depth: NDArray[np.float32]  # (h, w)


def match_frames(
    frames: FrameReader,
    world_to_camera: NDArray[np.float64],
    usable: NDArray[np.bool_],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
) -> Iterator[Matches | None]:
    """The matches of each frame, in order; None for a frame without partners.

    Args:
        frames: with depth in the unit of the path.
        world_to_camera: (T, 4, 4). usable: (T,) whether a frame has a pose of its own.
        matrix: (3, 3) K at `size`, px; the left-most pixel is centered at 0. size: (w, h) at which to match, px.
    """
    pictures: BoundedCache[_Picture] = BoundedCache(cache_bytes(), lambda each: 6 * each.depth.size)
    everything, count = range(len(usable)), int(np.clip(CORNERS / max(len(usable), 1), MIN_IN_FRAME, MAX_IN_FRAME))

    def picture(i: int) -> _Picture:
        return pictures.get(i, lambda: _picture(frames.frame(i), size))

    def distance(i: int) -> float:
        depth = picture(i).depth
        return float(np.median(depth[depth > 0])) if (depth > 0).any() else np.nan

    with frame_threads(BYTES_PER_PX * size[0] * size[1]) as pool:
        distances = np.array(list(pool.map(distance, everything)))
        usable = usable & np.isfinite(distances)
        partners = choose_partners(world_to_camera, matrix, size, np.where(usable, distances, 1.0), usable)

        def matched(i: int) -> Matches | None:
            others = partners[i]
            warps = [Warp.between(matrix, world_to_camera[i], world_to_camera[j], size) for j in others]
            return _matched(picture(i), others, [picture(j) for j in others], warps, count) if others else None

        yield from pool.map(matched, everything)


def _picture(seen: PoseInput, size: tuple[int, int]) -> _Picture:
    view = HighPassImage.of(seen.rgb_u8, seen.tissue_mask, size)
    std = float(view.detail[view.usable > 0].std()) if view.usable.any() else 1.0
    levels = np.clip(128 + 128 / (CONTRAST * max(std, 1e-6)) * view.detail, 0, 255).astype(np.uint8)
    depth = cv2.resize(seen.depth, size, interpolation=cv2.INTER_NEAREST)
    inner = cv2.erode((view.usable * (depth > 0)).astype(np.uint8) * 255, np.ones((2 * INNER_PX + 1,) * 2, np.uint8))
    return _Picture(levels, np.asarray(inner, np.uint8), np.asarray(depth, np.float32))


def _matched(
    here: _Picture, others: tuple[int, ...], there: Sequence[_Picture], warps: Sequence[Warp], count: int
) -> Matches:
    width = here.depth.shape[1]
    corners = cv2.goodFeaturesToTrack(here.detail_u8, count, QUALITY, max(APART * width, 4), mask=here.inner)
    pixels = np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners, np.float32).reshape(-1, 2)
    at = np.round(pixels).astype(int)
    inverse = np.where(here.depth > 0, 1 / np.maximum(here.depth, 1e-6), 0).astype(np.float32)
    seen = np.full((len(others), len(pixels), 2), np.nan, np.float32)
    for found, other, warp in zip(seen, there, warps, strict=True):
        if len(pixels):
            found[:] = _found(here.detail_u8, other, warp, inverse, pixels)
    return Matches(pixels, here.depth[at[:, 1], at[:, 0]], others, seen)


def _found(
    detail_u8: NDArray[np.uint8], other: _Picture, warp: Warp, inverse: NDArray[np.float32], pixels: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(N, 2) px of the corners (N, 2) in another frame, NaN where they are not found."""
    x, y, _ = (each.astype(np.float32) for each in warp.at(inverse))
    warped = np.asarray(cv2.remap(other.detail_u8, x, y, cv2.INTER_LINEAR, borderValue=128), np.uint8)
    now, back, good = track_forward_backward(
        detail_u8, warped, pixels, side_px=WINDOW_PX, halvings=LEVELS, criteria=STOP
    )
    good &= (np.hypot(*(back - pixels).T) < MAX_BACK_PX) & (np.hypot(*(now - pixels).T) < MAX_SHIFT_PX)
    place = np.stack([cv2.remap(each, now[:, :1], now[:, 1:], cv2.INTER_LINEAR).ravel() for each in (x, y)], 1)
    inner = cv2.remap(other.inner, place[:, :1], place[:, 1:], cv2.INTER_NEAREST, borderValue=0).ravel() > 0
    return np.where((good & inner)[:, None], place, np.nan).astype(np.float32)
