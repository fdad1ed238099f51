"""A second look at the path: cameras and lens are adjusted to direct matches of frames with parallax (`matches.py`).

Tracks go from frame to frame and their errors add up; of depth by parallax they are most of the error. Direct matches
remove that where the scene is rigid. Where tissue moves by itself they fit no camera, and the path stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .adjust import Adjusted, Observations, adjust, back_projected, residuals
from .even_view import matrix_at
from .matches import Matches, match_frames
from .path import CameraPath
from .tracks import PoseInput, TrackingCamera

MAX_WIDTH = 640  # frames are matched at this width at most, px
PIXEL_STD = 0.3  # of a match, px of an image 640 px wide
DEPTH_STD = 0.2  # of the depth so far, as a share of it: it holds the scale of the path
FOCAL_PRIOR, FOCAL_STD = 0.2, 0.03  # of log f where it is assumed; a refined one is kept if it is known this well
MIN_OBSERVATIONS = 30  # observations of a camera; with fewer it moves along with the nearest one that has more
SEEN_IN = 3  # frames that see a corner by which the fit is judged
FITS_PX = 0.5  # three quarters of the matches of a rigid scene are within this, px of an image 640 px wide
RIGID = 0.5  # weight of a corner that follows the rigid scene


@dataclass(frozen=True)
class Refined:
    """A path that is adjusted to direct matches."""

    path: CameraPath
    residual_px: float  # three quarters of the matches are within it, px of an image 640 px wide

    @property
    def fits(self) -> bool:
        """Whether the scene is rigid, so that the path is better than before."""
        return self.residual_px < FITS_PX


def refined_path(
    path: CameraPath,
    frame: Callable[[int], PoseInput],
    lens: TrackingCamera,
    size: tuple[int, int],
    *,
    refine_focal: bool,
) -> Refined | None:
    """Adjust a path to direct matches; None where too few frames have parallax.

    Args:
        frame: reads frame i, with its depth in the unit of the path.
        lens: with the focal length of the path. size: (width, height), px.
        refine_focal: the focal length is an assumption.
    """
    small = _scaled(size)
    matrix, px = matrix_at(lens.matrix, size, small), small[0] / 640
    poses = np.linalg.inv(path.camera_to_world)
    # Frames of one pose, in which the camera rests, are one camera.
    _, first, camera = np.unique(poses.reshape(len(poses), -1), axis=0, return_index=True, return_inverse=True)
    camera, stations = camera.ravel(), poses[first]
    matches = list(match_frames(frame, poses, path.explained, matrix, small))
    seen, points, known = _observations(matches, poses, camera, matrix, px)
    if known.sum() < 2:
        return None
    fixed = np.arange(len(stations)) == camera[np.flatnonzero(known[camera])[0]]
    found = adjust(matrix, stations, points, seen, fixed, focal_prior=FOCAL_PRIOR if refine_focal else 0.0, steps=3)
    if found.focal_std > FOCAL_STD:  # the matches do not determine it
        found = adjust(matrix, stations, points, seen, fixed, steps=3)
    if not (np.isfinite(found.poses).all() and np.isfinite(found.points).all()):
        return None
    new = _with_the_rest(stations, found.poses, known, first)[camera]
    new = new @ np.linalg.inv(new[0])  # the first frame is at the origin
    scales = path.depth_scale * _scales(found, seen, len(stations))[camera]
    focal = path.focal_factor * found.focal_factor
    done = replace(path, camera_to_world=np.linalg.inv(new), focal_factor=focal, depth_scale=scales)
    return Refined(done, PIXEL_STD * _residual(matrix, found, seen))


def _scaled(size: tuple[int, int]) -> tuple[int, int]:
    """(w, h) at which frames of (width, height) are matched, px."""
    factor = min(1.0, MAX_WIDTH / size[0])
    return round(size[0] * factor), round(size[1] * factor)


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
    judged = np.bincount(seen.point)[seen.point] >= SEEN_IN
    return float(np.quantile(error[judged], 0.75)) if judged.any() else np.inf
