"""What is recognized in another frame: corners in the next one, SIFT keypoints (Lowe 2004) of keyframes in any.

`N` corners, px counted from 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...footage.alignment import align
from ...footage.keypoints import keypoints, track_points
from ...footage.optical_flow import fixed_in_image
from ...priors.specular import specular_likelihood
from .adjust import back_projected, coarse_pose
from .tracks import PoseInput, TrackingCamera

MAX_CORNERS = 500
REFRESH = 0.8  # new corners are detected when fewer than this share of `MAX_CORNERS` is left
EDGE_STEP = 0.05  # no corners where depth changes by more than this share between neighbors: those are depth edges
CELLS = (8, 6)  # columns and rows of the image; no cell holds more than twice its share of the corners
FLAT_WIDTHS, FLAT_CONTRAST = 64, 300.0  # shading is left by a blur of width / 64 px; contrast of the rest, gray levels
EDGE_PX, FADE_WIDTHS = 3.0, 32
"""Tissue fades out over width / 32 px before a border or a tool, whose outlines would hold corners where they are;
beyond, there is a blur of it. Corners are where more than half is left."""
COARSE_HALVINGS, FINE_HALVINGS = 4, 1  # how often images are halved to follow corners: plain images, then flat ones
FINE_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.01)
FINE_PX = 2.0  # the two results differ by less than this
COARSE_FLAT_WIDTHS, BLUR_WIDTHS = 28, 160
"""Where corners are few, detail between blurs of width / 160 and width / 28 px is followed: finer patterns of sensor or
fibers stay where they are while the view moves."""
EXPECTED_PX = 10.0  # parallax: a corner is this far from where the image as a whole goes, px of an image 640 px wide
KEYPOINTS = 600
RATIO = 0.8  # the best match is nearer than the second best by this factor (Lowe's ratio test)
MIN_POSE_INLIERS = 20  # fewer matches that one pose explains may be chance
INLIER_PX = 4.0  # reprojection error of a match, px of an image 640 px wide: the tissue may have moved in between


@dataclass(frozen=True)
class TrackingFrame:
    """A frame as points are recognized in it."""

    plain: NDArray[np.uint8]  # (H, W) brightness: finds large motion
    flat: NDArray[np.uint8]  # (H, W) without shading: what the light paints moves with the camera
    usable: NDArray[np.bool_]  # (H, W) see `usable_tissue`
    depth: NDArray[np.float32]  # (H, W) 0 where missing


def tracking_frame(seen: PoseInput, *, coarse: bool = False) -> TrackingFrame:
    """Prepare a frame. Args: coarse: whether corners are few, so that larger detail is followed."""
    plain = np.asarray(cv2.cvtColor(seen.rgb_u8, cv2.COLOR_RGB2GRAY), np.uint8)
    width, usual = plain.shape[1], float(np.median(plain))
    inside_px = cv2.distanceTransform(seen.tissue_mask.astype(np.uint8), cv2.DIST_L2, 5) - EDGE_PX
    tissue = np.clip(inside_px / (width / FADE_WIDTHS), 0, 1).astype(np.float32)
    if (tissue <= 0).any():
        filled = np.where(tissue > 0, plain, _smooth(plain, tissue, width / FADE_WIDTHS, usual))
        plain = filled.astype(np.uint8)
    if coarse:
        plain = np.asarray(cv2.GaussianBlur(plain, (0, 0), width / BLUR_WIDTHS), np.uint8)
    bright = np.log(plain.astype(np.float32) + 8)
    sigma = max(width / (COARSE_FLAT_WIDTHS if coarse else FLAT_WIDTHS), 2.0)
    bright = (bright - _smooth(bright, tissue, sigma, 0.0)) * tissue
    flat = np.clip(bright * FLAT_CONTRAST + 128, 0, 255).astype(np.uint8)
    measured = np.isfinite(seen.depth) & (seen.depth > 0)
    return TrackingFrame(
        plain, flat, usable_tissue(seen) & (tissue > 0.5), np.where(measured, seen.depth, np.float32(0))
    )


def _smooth(image: NDArray, weight: NDArray[np.float32], sigma: float, far: float) -> NDArray[np.float32]:
    """(H, W) blur of what has weight (H, W); `far` where that is many sigma away."""
    total, share = (cv2.GaussianBlur(part, (0, 0), sigma) for part in ((image - np.float32(far)) * weight, weight))
    return np.asarray(total / np.maximum(share, np.float32(1e-3)) + np.float32(far), np.float32)


def usable_tissue(seen: PoseInput) -> NDArray[np.bool_]:
    """(H, W) where the image shows tissue that belongs to a place: off tools, borders and highlights."""
    height, width = seen.tissue_mask.shape
    small = cv2.resize(seen.rgb_u8, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    glint = (specular_likelihood(small * np.float32(1 / 255)) > 0.5).astype(np.uint8)
    glint = cv2.resize(cv2.dilate(glint, np.ones((3, 3))), (width, height), interpolation=cv2.INTER_NEAREST)
    tissue = seen.tissue_mask.astype(np.uint8)
    inner = cv2.erode(tissue, np.ones((7, 7)), borderType=cv2.BORDER_CONSTANT, borderValue=(0,))
    return (inner & (1 - glint)).astype(bool)


def new_corners(view: TrackingFrame, taken: NDArray[np.float32]) -> NDArray:
    """(N, 2) corners on smooth tissue with depth, away from those `taken` (M, 2); none if these are enough."""
    if len(taken) >= REFRESH * MAX_CORNERS:
        return np.zeros((0, 2), np.float32)
    depth = view.depth
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    allowed = (view.usable & (near > 0) & (far - near < EDGE_STEP * depth)).astype(np.uint8)
    height, width = depth.shape
    apart = max(5, width // 80)
    for x, y in taken:
        cv2.circle(allowed, (round(float(x)), round(float(y))), apart, 0, -1)
    found = cv2.goodFeaturesToTrack(view.flat, 3 * MAX_CORNERS, 0.002, apart, mask=allowed)
    if found is None:
        return np.zeros((0, 2), np.float32)
    found = found.reshape(-1, 2)  # strongest first
    cell, before = _cells(found, width, height), np.bincount(_cells(taken, width, height), minlength=np.prod(CELLS))
    most = 2 * MAX_CORNERS // int(np.prod(CELLS))
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(np.prod(CELLS)))
    rank = np.empty(len(found), int)
    rank[order] = np.arange(len(found)) - first[cell[order]]
    return found[rank + before[cell] < most][: max(MAX_CORNERS - len(taken), 0)]


def _cells(pixels: NDArray, width: int, height: int) -> NDArray[np.intp]:
    column = np.clip((pixels[:, 0] * CELLS[0] / width).astype(int), 0, CELLS[0] - 1)
    return np.clip((pixels[:, 1] * CELLS[1] / height).astype(int), 0, CELLS[1] - 1) * CELLS[0] + column


def followed(before: TrackingFrame, now: TrackingFrame, pixels: NDArray) -> tuple[NDArray, NDArray]:
    """Follow corners (N, 2) by Lucas-Kanade flow, forward and backward: indices of those kept, and their pixels."""
    if not len(pixels):
        return np.zeros(0, np.intp), pixels
    near, good = track_points(before.plain, now.plain, pixels, halvings=COARSE_HALVINGS)
    there, still_good = track_points(
        before.flat, now.flat, pixels, halvings=FINE_HALVINGS, guess=near, criteria=FINE_CRITERIA
    )
    good &= still_good & (np.abs(there - near).max(1) < FINE_PX) & (sampled(now.usable, there) > 0)
    kept = np.flatnonzero(good)
    return kept, there[kept]


def followed_directly(before: TrackingFrame, now: TrackingFrame, pixels: NDArray) -> tuple[NDArray, NDArray] | None:
    """As `followed`, each corner from where the image as a whole goes; None if the two images do not say where."""
    step = align(before.plain, now.plain, before.usable, now.usable)
    if step is None:
        return None
    expected = (pixels @ step[:2, :2].T + step[:2, 2]).astype(np.float32)
    if not len(pixels):
        return np.zeros(0, np.intp), pixels
    there, good = track_points(
        before.flat,
        now.flat,
        pixels,
        side_px=31,
        halvings=FINE_HALVINGS,
        guess=expected,
        criteria=FINE_CRITERIA,
    )
    px = now.flat.shape[1] / 640
    good &= ~fixed_in_image(there - pixels, expected - pixels, now.flat.shape[1])
    good &= (np.linalg.norm(there - expected, axis=1) < EXPECTED_PX * px) & (sampled(now.usable, there) > 0)
    kept = np.flatnonzero(good)
    return kept, there[kept]


def sampled(image: NDArray, pixels: NDArray) -> NDArray:
    """(N,) values at the pixels nearest to (N, 2); 0 outside the image."""
    height, width = image.shape
    at = np.round(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).astype(int)
    inside = (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
    at = np.where(inside[:, None], at, 0)
    return np.where(inside, image[at[:, 1], at[:, 0]], 0)


@dataclass
class Keyframe:
    """What is kept of a keyframe."""

    frame: int
    pixels: NDArray[np.float32]  # (M, 2) px
    depths: NDArray[np.float32]  # (M,) mm before any scale, > 0
    descriptors: NDArray[np.uint8]  # (M, 128)
    track: NDArray[np.int32]  # (M,) id of the track of the keypoint, -1 without one


@dataclass(frozen=True)
class KeyframeMatch:
    """A keyframe recognized in another one."""

    pose: NDArray  # (4, 4) world-to-camera of the new one, in the world of the old one
    old: NDArray[np.intp]  # (N,) keypoints of the old one ...
    new: NDArray[np.intp]  # ... that are these of the new one
    scale: float  # depth in the world of the old one, as a multiple of the new one's own depth


def keyframe(index: int, view: TrackingFrame) -> Keyframe:
    """Describe a frame by its SIFT keypoints on tissue with depth."""
    mask = (view.usable & (view.depth > 0)).astype(np.uint8)
    pixels, descriptors = keypoints(view.plain, KEYPOINTS, mask, 0.01)
    depths = sampled(view.depth, pixels).astype(np.float32)
    kept = depths > 0
    no_track = np.full(kept.sum(), -1, np.int32)
    return Keyframe(index, pixels[kept], depths[kept], descriptors[kept].astype(np.uint8), no_track)


def match_keyframe(
    camera: TrackingCamera, old: Keyframe, old_pose: NDArray, old_scale: float, new: Keyframe
) -> KeyframeMatch | None:
    """Find the pose of `new` from what it shares with `old`; None if that is too little."""
    first, second = _matches(old.descriptors.astype(np.float32), new.descriptors.astype(np.float32))
    if len(first) < MIN_POSE_INLIERS:
        return None
    points = back_projected(camera.matrix, old_pose, old.pixels[first], old.depths[first] * old_scale)
    found = coarse_pose(camera.matrix, points, new.pixels[second], None, INLIER_PX * camera.px)
    if found is None or found[1].sum() < max(MIN_POSE_INLIERS, 0.25 * len(first)):
        return None
    pose, inlier = found
    z = points[inlier] @ pose[2, :3] + pose[2, 3]
    scale = float(np.median(z / new.depths[second[inlier]]))
    if not scale > 0:
        return None
    return KeyframeMatch(pose, first[inlier], second[inlier], scale)


def _matches(a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    """Mutual nearest neighbors that pass the ratio test."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = (a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * a @ b.T
    best = np.argmin(distance, 1)
    two = np.partition(distance, 1, 1)[:, :2]
    good = (two[:, 0] < RATIO**2 * two[:, 1]) & (np.argmin(distance, 0)[best] == np.arange(len(a)))
    return np.flatnonzero(good), best[good]
