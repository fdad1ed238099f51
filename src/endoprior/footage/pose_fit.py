"""Do camera poses explain the images? Corners on tissue are followed, and their depth is reprojected with the poses.

A wrong convention moves the points of one frame to the wrong pixels of another one. The convention that brings them to
the followed corners is the right one: deforming tissue adds the same error to all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import CONVENTIONS, Convention, to_ours
from ..core.ranges import evenly_spaced
from .image_operations import Image, InOrder, square
from .keypoints import track_points

RgbdFrame = tuple[Image, NDArray, NDArray[np.float32]]
"""Of a frame: (H, W, 3) image, (H, W) True on tissue, (H, W) depth in mm, 0 where missing."""
WORK_WIDTH = 320  # Wider images are resized to this width, px
STARTS = 10  # Number of frames from which corners are followed
REACH = 24  # ... over so many frames at most ...
FAR = 0.05  # ... or until they have moved by this share of the image width (median).
MAX_CORNERS, MIN_CORNERS = 200, 40
EDGE_STEP = 0.05  # No corners where depth changes by more than this share between neighbors
MIN_ERROR_PX = 1.0  # Errors below this, px of an image 640 px wide, come from corners and tissue: nothing is wrong
AS_GOOD = 1.15  # Conventions whose errors differ by less than this factor are not told apart
NONE_PX, NONE_FIT = 3.0, ((1.05, 3.0), (0.6, 10.0))
"""Poses do not fit at all if their error is above the first, px, and above both multiples of one pair: of the error
without motion, and of that of the best rigid motion. Tissue that moves makes the latter small and the error large."""
CLEARLY, STILL = 0.65, 0.95
"""Another convention fits better if its error is less than the first share of the given one's, and less than the
second share of that without motion."""
SCALES, FINER = np.geomspace(1e-4, 1e5, 37), np.geomspace(0.6, 1 / 0.6, 9)
"""Lengths of a unit that are tried, as multiples of the given one; then around the best."""
INLIER_PX = 3.0
PLAIN_UNITS, SAME_UNIT = (1.0, 1000.0, 10.0, 1e-3, 0.1), 2.5
"""Up to this factor a unit is one of those: tissue that breathes with the camera shifts the best one."""


@dataclass(frozen=True)
class PoseFit:
    """How well poses explain the images. Errors are medians over corners, px of an image 640 px wide."""

    given_px: float  # Error of the poses as given
    still_px: float  # Error without any camera motion
    rigid_px: float  # Error of the rigid motion that fits each pair of frames best: tissue deforms
    moved_px: float  # Motion that the poses as given predict
    best: Convention  # The convention that fits best ...
    unit: float  # ... with this length of a unit, as a multiple of the given one ...
    best_px: float  # ... and its error.
    as_good: tuple[Convention, ...] = ()
    """Others that fit as well with this unit: the camera moves too little to tell them apart."""

    @property
    def another_fits(self) -> bool:
        """Whether another convention or unit fits clearly better than the given one."""
        return self.given_px > MIN_ERROR_PX and self.best_px < min(CLEARLY * self.given_px, STILL * self.still_px)

    @property
    def none_fits(self) -> bool:
        """Whether the poses move the camera, but not in the way in which the images move."""
        least = min(max(still * self.still_px, rigid * self.rigid_px) for still, rigid in NONE_FIT)
        wrong = self.given_px > max(NONE_PX, least)
        return not self.another_fits and wrong and self.moved_px > self.given_px / 2

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        words = f"{self.given_px:.1f} px as given, {self.still_px:.1f} without camera motion"
        return f"{words}, {self.best_px:.1f} as {self.name}" if self.another_fits else words

    @property
    def name(self) -> str:
        """The best convention and unit, in words."""
        words = " or ".join((self.best, *self.as_good))
        return words if self.unit == 1 else f"{words} with a unit of {self.unit:.4g} mm"


@dataclass(frozen=True)
class _Tracks:
    """Corners of one frame, found again in a later one."""

    first: int
    last: int
    matrix: NDArray[np.float64]  # (3, 3) K, px
    points: NDArray[np.float64]  # (N, 3) place in the first camera, mm
    before: NDArray[np.float64]  # (N, 2) px there
    after: NDArray[np.float64]  # (N, 2) px in the last frame
    side: int  # Longer side of the image, px

    def still(self) -> NDArray[np.float64]:
        """(N,) how far the corners moved, px."""
        return np.linalg.norm(self.after - self.before, axis=1)

    def rigid(self) -> NDArray[np.float64]:
        """(N,) distance from the followed corners after the rigid motion that explains most of them, px."""
        nothing = np.zeros(0)
        found, turn, shift, _ = cv2.solvePnPRansac(
            self.points, self.after, self.matrix, nothing, reprojectionError=INLIER_PX
        )
        if not found:
            return np.full(len(self.after), np.inf)
        pixels, _ = cv2.projectPoints(self.points, turn, shift, self.matrix, nothing)
        return np.linalg.norm(pixels[:, 0] - self.after, axis=1)

    def errors(self, poses: NDArray[np.float64], goal: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """(N,) distance of the reprojected points from `goal`, by default the followed corners, px; at most the image's
        size, which also counts behind the camera.
        """
        first, last = poses[self.first], poses[self.last]
        world = self.points @ first[:3, :3].T + first[:3, 3]
        there = (world - last[:3, 3]) @ last[:3, :3]
        ahead = there[:, 2] > 1e-6
        pixels = (there @ self.matrix.T)[:, :2] / np.where(ahead, there[:, 2], 1)[:, None]
        off = np.linalg.norm(pixels - (self.after if goal is None else goal), axis=1)
        return np.where(ahead, np.minimum(off, self.side), self.side)


def measure_poses(
    view: Callable[[int], RgbdFrame],
    matrix: NDArray[np.float64],
    poses: NDArray[np.float64],
    given: Convention = "opencv",
    *,
    turn: NDArray[np.float64] | None = None,
    relative: bool = False,
    each: InOrder = map,
) -> PoseFit | None:
    """Compare all conventions of poses; None if the poses do not move, or if too few corners can be followed.

    Args:
        view: reads frame i; few frames are read, in ascending order from each start.
        matrix: (3, 3) K, px; pixel centers count from 0.
        poses: (T, 4, 4) as the file has them, which is read as `given` at present.
        turn: (3, 3) rotation from the camera that the poses belong to, to that of the frames.
        relative: whether the unit of the depth is unknown, so that any unit of the poses is right.
        each: as `map`; threads can give the results, in order.
    """
    if len(poses) < 2 or np.abs(poses - poses[0]).max() < 1e-6:
        return None
    width = view(0)[0].shape[1]
    factor = min(1.0, WORK_WIDTH / width)
    px = 640 / (factor * width)
    matrix = np.diag([factor, factor, 1]) @ matrix + [[0, 0, (factor - 1) / 2], [0, 0, (factor - 1) / 2], [0, 0, 0]]
    starts = evenly_spaced(len(poses) - 1, STARTS)

    def follow(start: int) -> _Tracks | None:
        return _follow(lambda j: _small(view(j), factor), matrix, start, len(poses))

    tracks = [found for found in each(follow, starts) if found]
    if not tracks:
        return None

    def median(errors: Callable[[_Tracks], NDArray[np.float64]]) -> float:
        return px * float(np.median(np.concatenate([errors(each) for each in tracks])))

    def read(convention: Convention, unit: float) -> NDArray[np.float64]:
        ours = to_ours(poses, convention, unit)
        if turn is not None:
            ours[:, :3, :3] = ours[:, :3, :3] @ turn.T
        return ours

    def error(convention: Convention, unit: float) -> float:
        ours = read(convention, unit)
        return median(lambda each: each.errors(ours))

    fits: list[tuple[float, Convention, float]] = []
    for convention in sorted(CONVENTIONS, key=lambda each: each != given):
        unit = _best_unit(partial(error, convention))
        fits.append((error(convention, unit), convention, unit))
    least, best, unit = min(fits, key=lambda fit: fit[0])
    ours = read(given, 1.0)
    return PoseFit(
        given_px=fits[0][0] if relative else error(given, 1.0),
        still_px=median(_Tracks.still),
        rigid_px=median(_Tracks.rigid),
        moved_px=median(lambda each: each.errors(ours, each.before)),
        best=best,
        unit=1.0 if relative else unit,
        best_px=least,
        as_good=tuple(name for at, name, of in fits if name != best and of == unit and at < AS_GOOD * least),
    )


def _best_unit(error: Callable[[float], float]) -> float:
    unit = min(SCALES.tolist(), key=error)
    plain = next((each for each in PLAIN_UNITS if 1 / SAME_UNIT < unit / each < SAME_UNIT), None)
    return plain or min((unit * FINER).tolist(), key=error)


def _small(view: RgbdFrame, factor: float) -> RgbdFrame:
    """Gray image, tissue and depth of a frame at the working size."""
    rgb_u8, tissue, depth = view
    gray = np.asarray(cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY), np.uint8)
    if factor == 1:
        return gray, tissue, depth
    size = round(gray.shape[1] * factor), max(round(gray.shape[0] * factor), 1)
    tissue = cv2.resize(tissue.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    depth = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8), tissue, depth


def _follow(view: Callable[[int], RgbdFrame], matrix: NDArray, start: int, count: int) -> _Tracks | None:
    """Follow corners from a frame until they are far away; None if too few are left."""
    gray, tissue, depth = view(start)
    before = _corners(gray, tissue, depth)
    kept, pixels, last = np.arange(len(before)), before, start
    for index in range(start + 1, min(start + REACH + 1, count)):
        following, tissue, _ = view(index)
        if len(kept) < MIN_CORNERS:
            return None
        there, good = track_points(gray, following, pixels)
        good &= _sampled(tissue, there) > 0
        if good.sum() < MIN_CORNERS:
            break
        kept, pixels, gray, last = kept[good], there[good], following, index
        if np.median(np.linalg.norm(pixels - before[kept], axis=1)) > FAR * gray.shape[1]:
            break
    if last == start:
        return None
    corners = before[kept].astype(np.float64)
    rays = np.concatenate([corners, np.ones((len(kept), 1))], 1) @ np.linalg.inv(matrix).T
    points = rays * _sampled(depth, before[kept]).astype(np.float64)[:, None]
    return _Tracks(start, last, matrix, points, corners, pixels.astype(np.float64), max(gray.shape))


def _corners(gray: Image, tissue: NDArray, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 2) corners on smooth tissue with depth."""
    near, far = cv2.erode(depth, square(1)), cv2.dilate(depth, square(1))
    inner = cv2.erode(tissue.astype(np.uint8), square(4), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    allowed = inner * ((near > 0) & (far - near < EDGE_STEP * depth)).astype(np.uint8)
    found = cv2.goodFeaturesToTrack(gray, MAX_CORNERS, 0.003, max(5, gray.shape[1] // 80), mask=allowed)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found.reshape(-1, 2), np.float32)


def _sampled(image: NDArray, pixels: NDArray[np.float32]) -> NDArray:
    """(N,) values at the nearest pixels; 0 outside."""
    at = np.round(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).astype(int)
    inside = (at >= 0).all(1) & (at[:, 0] < image.shape[1]) & (at[:, 1] < image.shape[0])
    at = np.where(inside[:, None], at, 0)
    return np.where(inside, image[at[:, 1], at[:, 0]], 0)
