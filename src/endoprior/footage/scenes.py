"""Which images show the same tissue, by corners that are followed, else by features; and where a video is cut.

At a cut the image changes at once, most images before it show one place and most after it another, and no tissue of
before is found again. Smoke, a tool that moves, blur, a flash, a fold that swings in and a camera that jerks change the
image, too, but the tissue is the same before and after.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .alignment import align
from .image_operations import Image, Mask
from .keypoints import keypoints, match_descriptors, track_points

CORNERS, FEATURES = 200, 400  # most corners that are followed, and features that are compared, in an image
MIN_MATCHES = 12  # so many points must move together; of images of different places, up to 7 do by chance
SHARE = 0.4  # share of the corners, or of the pairs of features, that must move together
NEAR_PX, LIKE_PX = 2.0, 5.0  # largest distance of a point from where the common motion takes it: corners, features
DISTINCT = 0.8  # a feature is found again if the second best candidate is farther from it by this factor


class ImageFeatures:
    """One small gray image (h, w), see `disturbances.small_size`, and its features once they are asked for."""

    def __init__(self, gray: Image, inside: Mask | None = None) -> None:
        """Args: inside: (h, w) True where points may lie; None for everywhere."""
        self.gray, self._inside = gray, None if inside is None else inside.astype(np.uint8)

    @cached_property
    def corners(self) -> NDArray[np.float32]:
        """(N, 2) px."""
        found = cv2.goodFeaturesToTrack(self.gray, CORNERS, 0.01, 6, mask=self._inside)
        return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)

    @cached_property
    def features(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(N, 2) px, and what each looks like, (N, 128)."""
        even = cv2.createCLAHE(2.0, (8, 8)).apply(self.gray)  # haze lowers contrast
        return keypoints(np.asarray(even, np.uint8), FEATURES, self._inside, 0.01)


class GlobalMotion(NamedTuple):
    """The common motion from one image to another."""

    shift: float  # mean shift of 9 points spread over the image, as a share of its width
    residual: float  # median distance of the points from where it takes them, as a share of the width
    agreement: float  # share of the points that follow it


def motion_by_flow(before: ImageFeatures, now: ImageFeatures) -> GlobalMotion | None:
    """The common motion of corners from an image to the next one; None if too few are found again."""
    corners = before.corners
    if len(corners) < MIN_MATCHES:
        return None
    there, good = track_points(before.gray, now.gray, corners, side_px=15)
    return _global_motion(corners[good], there[good], len(corners), NEAR_PX, now.gray.shape[1])


def motion_by_features(before: ImageFeatures, now: ImageFeatures) -> GlobalMotion | None:
    """The common motion of features between any two images; None if too few are found again."""
    (first, first_descriptors), (second, second_descriptors) = before.features, now.features
    if min(len(first), len(second)) < MIN_MATCHES:
        return None
    here, there = match_descriptors(first_descriptors, second_descriptors, DISTINCT)
    return _global_motion(first[here], second[there], len(here), LIKE_PX, now.gray.shape[1])


def _global_motion(
    a: NDArray[np.float32], b: NDArray[np.float32], of: int, near_px: float, width: int
) -> GlobalMotion | None:
    if len(a) < MIN_MATCHES:
        return None
    cv2.setRNGSeed(0)  # RANSAC uses OpenCV's own random generator
    matrix, inliers = cv2.estimateAffinePartial2D(a, b, ransacReprojThreshold=near_px)
    if matrix is None or inliers.sum() < MIN_MATCHES or inliers.sum() < SHARE * of:
        return None
    x, y = np.meshgrid(*(np.linspace(side.min(), side.max(), 3) for side in a.T))
    grid = np.stack([x.ravel(), y.ravel()], 1)
    away = np.linalg.norm(a @ matrix[:, :2].T + matrix[:, 2] - b, axis=1)
    shift = np.linalg.norm(grid @ matrix[:, :2].T + matrix[:, 2] - grid, axis=1).mean()
    return GlobalMotion(float(shift) / width, float(np.median(away)) / width, float(inliers.sum() / of))


def same_view(befores: Sequence[ImageFeatures], afters: Sequence[ImageFeatures]) -> bool:
    """Whether images before and after an event, the nearest first, show the same tissue.

    By the features of any two, or if the nearest ones can be aligned: smooth tissue has no features.
    """
    found = any(motion_by_features(before, after) is not None for before in befores for after in afters)
    return found or align(befores[0].gray, afters[0].gray) is not None


THUMB_WIDTH = 64  # images that follow each other are compared at this width, px
MIN_SPREAD = 8.0  # standard deviation of gray levels below which an image shows next to nothing
JUMP, JUMP_RATIO = 0.25, 3.0
"""Least change of the image at a cut, in standard deviations, and relative to the usual change around it."""
ALIKE = 0.88  # largest correlation with the image before, shifted as fits best; what moves a little has more
REACH = 6  # so many images before and after what looks like a cut are compared
HALF_ALIKE = 0.97  # least correlation of a half that stays; the border of round images alone reaches 0.955
HALF_SHIFT = 8  # a half may move by this part of its shorter side
HALF_SPREAD = 0.3  # least standard deviation of a half that shows something, of that of the whole thumbnail
AROUND_S = 0.5  # what is around it, s


def standardized(thumb: NDArray) -> NDArray[np.float32]:
    """Gray values (h, w) as float32 of mean 0 and standard deviation 1, so that exposure does not matter."""
    values = thumb.astype(np.float32)
    return (values - values.mean()) / max(float(values.std()), MIN_SPREAD)


def change(before: NDArray[np.float32], now: NDArray[np.float32]) -> float:
    """Mean difference of two thumbnails, see `standardized`; 0 where a shift explains it."""
    found = float(np.abs(now - before).mean())
    if found <= JUMP:
        return found
    rows, columns = (side // 5 for side in now.shape)
    middle = np.ascontiguousarray(before[rows : len(before) - rows, columns : before.shape[1] - columns])
    if min(middle.std(), now.std()) < 0.1:  # black or white: any two are alike
        return found
    return 0.0 if cv2.matchTemplate(now, middle, cv2.TM_CCOEFF_NORMED).max() > ALIKE else found


def places_differ(before: Sequence[NDArray[np.float32]], after: Sequence[NDArray[np.float32]]) -> bool:
    """Whether thumbnails before an event show one place, and those after it another.

    No if the view comes back, as after a jerk of the camera or a flash; if no view lasts, as while the camera is swept;
    or if half of the image stays, as where a fold swings in.

    Args:
        before, after: up to `REACH` thumbnails each, see `standardized`, in the order of time.
    """
    images, split = [*before, *after], len(before)
    pairs = combinations(range(len(images)), 2)
    alike = [(i, j) for i, j in pairs if change(images[i], images[j]) <= JUMP]
    place = connected(len(images), alike)
    first, second = place[:split], place[split:]
    lasting = all(2 * np.bincount(side).max() >= len(side) for side in (first, second))
    return lasting and not np.isin(first, second).any() and not half_stays(before[-1], after[0])


def half_stays(before: NDArray[np.float32], now: NDArray[np.float32]) -> bool:
    """Whether the left, right, upper or lower half of a thumbnail, see `standardized`, is in the next one.

    What swings in from a side leaves the other half as it was.
    """
    rows, columns = (side // 2 for side in now.shape)
    for part in np.s_[:, :columns], np.s_[:, -columns:], np.s_[:rows], np.s_[-rows:]:
        half, there = before[part], np.ascontiguousarray(now[part])
        margin = max(min(half.shape) // HALF_SHIFT, 1)
        inner = np.ascontiguousarray(half[margin:-margin, margin:-margin])
        if not inner.size or min(inner.std(), there.std()) < HALF_SPREAD:
            continue
        if cv2.matchTemplate(there, inner, cv2.TM_CCOEFF_NORMED).max() > HALF_ALIKE:
            return True
    return False


def jumps(seconds: NDArray[np.float64], changes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) True where an image is suddenly another one than the image before.

    Args:
        seconds: (N,) times of the images, ascending.
        changes: (N,) `change` of each thumbnail from the one before.
    """
    found = np.zeros(len(changes), bool)
    for i in np.flatnonzero(changes > JUMP):
        first, end = np.searchsorted(seconds, [seconds[i] - AROUND_S, seconds[i] + AROUND_S])
        others = np.delete(changes[first:end], i - first)
        found[i] = changes[i] > JUMP_RATIO * (np.median(others) if len(others) else 0)
    return found


def connected(count: int, links: Sequence[tuple[int, int]]) -> NDArray[np.int32]:
    """(T,) a number for each set of images that are linked, one by one, by showing the same tissue."""
    first, second = np.array(links, np.int64).reshape(-1, 2).T
    return connected_components(coo_array((np.ones(len(first)), (first, second)), (count, count)), directed=False)[1]


def breaks(count: int, links: Iterable[tuple[int, int]]) -> NDArray[np.bool_]:
    """(T,) True at images from which on no tissue of the images before is found again; the first one is False.

    Args:
        links: pairs of images, the earlier one first, that show the same tissue.
    """
    bridges = np.zeros(count + 1, np.int64)
    for before, after in links:
        bridges[before + 1] += 1
        bridges[after + 1] -= 1
    is_break = np.cumsum(bridges)[:count] == 0
    is_break[:1] = False
    return is_break
