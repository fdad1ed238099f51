"""What camera tracking reads and keeps: frames, camera, tracks of points. `T` frames, `P` points."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .adjust import Observations, Resected, refined_pose

HELD_OUT = 8  # one in this many tracks takes no part in any estimate: it measures how well a path explains the frames
PIXEL_STD = 0.5  # error of a followed corner, px of an image 640 px wide
KEYPOINT_STD = 1.0  # error of a matched keypoint, px of an image 640 px wide
DISPARITY_STD = 0.2  # error of stereo, px
DEPTH_STD = {False: 0.02, True: 0.15}  # error of other depth as a share of it, by whether it is relative


@dataclass(frozen=True)
class PoseInput:
    """One frame for camera tracking."""

    rgb_u8: NDArray[np.uint8]  # (H, W, 3)
    tissue_mask: NDArray[np.bool_]  # (H, W) True outside tools
    depth: NDArray[np.float32]  # (H, W) mm, 0 where missing


@dataclass(frozen=True)
class FrameReader:
    """Reads the frames of a sequence when they are needed."""

    color: Callable[[int], NDArray[np.uint8]]  # (H, W, 3) of frame i
    tissue: Callable[[int], NDArray[np.bool_]]  # (H, W) True outside tools
    depth: Callable[[int], NDArray[np.float32]]  # (H, W) mm or relative, 0 where missing
    count: int

    def frame(self, index: int) -> PoseInput:
        """A frame with all its parts."""
        return PoseInput(self.color(index), self.tissue(index), self.depth(index))


@dataclass(frozen=True)
class TrackingCamera:
    """A pinhole camera whose depth was measured; pixel centers are counted from 0, as in OpenCV."""

    matrix: NDArray  # (3, 3) K, px
    size: tuple[int, int]  # (width, height) of the image, px
    depth_is_relative: bool  # each frame's depth has a scale of its own
    baseline_mm: float | None = None  # distance between the cameras that measured the depth, mm
    focal_is_assumed: bool = False  # so that the path may refine it

    @classmethod
    def centered_at_half(
        cls,
        matrix: NDArray,
        size: tuple[int, int],
        depth_is_relative: bool,
        baseline_mm: float | None = None,
        focal_is_assumed: bool = False,
    ) -> TrackingCamera:
        """From K with the left-most pixel centered at 0.5."""
        opencv = np.array(matrix, np.float64)
        opencv[:2, 2] -= 0.5
        return cls(opencv, size, depth_is_relative, baseline_mm, focal_is_assumed)

    def with_focal(self, factor: float) -> TrackingCamera:
        """The camera with both focal lengths multiplied."""
        matrix = self.matrix.copy()
        matrix[[0, 1], [0, 1]] *= factor
        return replace(self, matrix=matrix)

    @property
    def px(self) -> float:
        """Length of a pixel of an image 640 px wide, in px of this one: thresholds are multiples of it."""
        return self.size[0] / 640


class Tracks:
    """Observations by frame, and the points they belong to."""

    def __init__(self, camera: TrackingCamera) -> None:
        self.camera = camera
        self.ids: list[NDArray[np.int32]] = []
        self.pixels: list[NDArray[np.float32]] = []
        self.depths: list[NDArray[np.float32]] = []
        self.points, self.weight = np.zeros((0, 3)), np.zeros(0)
        self.keypoint, self.adjusted = np.zeros(0, bool), np.zeros(0, bool)

    @property
    def count(self) -> int:
        """P."""
        return len(self.points)

    def copy(self) -> Tracks:
        """The same observations; points and weights of its own."""
        out = copy.copy(self)
        out.points, out.weight = self.points.copy(), np.ones_like(self.weight)
        out.adjusted = np.zeros_like(self.adjusted)
        return out

    def add_points(self, points: NDArray, *, keypoint: bool) -> NDArray[np.int32]:
        """Ids of new points (N, 3)."""
        first, more = self.count, len(points)
        self.points = np.concatenate([self.points, points])
        self.weight = np.append(self.weight, np.ones(more))
        self.keypoint = np.append(self.keypoint, np.full(more, keypoint))
        self.adjusted = np.append(self.adjusted, np.zeros(more, bool))
        return np.arange(first, self.count, dtype=np.int32)

    def see(self, frame: int, ids: NDArray, pixels: NDArray, depths: NDArray) -> None:
        """Add observations to a frame; depth in mm before any scale, 0 where missing."""
        parts = (self.ids, ids, np.int32), (self.pixels, pixels, np.float32), (self.depths, depths, np.float32)
        for stored, new, kind in parts:
            stored += [np.zeros((0, *new.shape[1:]), kind)] * (frame + 1 - len(stored))
            stored[frame] = np.concatenate([stored[frame], new.astype(kind)])

    def held_out(self, ids: NDArray) -> NDArray[np.bool_]:
        """(N,) which tracks take no part in estimates."""
        return ids % HELD_OUT == HELD_OUT - 1

    def measured(self, ids: NDArray, depths: NDArray) -> tuple[NDArray, NDArray]:
        """(N,) inverse depth, 1/mm, and (N, 2) standard deviations of pixel and inverse depth."""
        camera, there = self.camera, depths > 0
        inverse = 1 / np.where(there, depths.astype(np.float64), 1.0)
        if camera.baseline_mm and not camera.depth_is_relative:
            std = np.full(len(ids), DISPARITY_STD / (camera.matrix[0, 0] * camera.baseline_mm))
        else:
            std = DEPTH_STD[camera.depth_is_relative] * inverse
        pixel = np.where(self.keypoint[ids], KEYPOINT_STD, PIXEL_STD) * camera.px
        return inverse, np.stack([pixel, np.where(there, std, np.inf)], 1)

    def refined(self, start: NDArray, ids: NDArray, points: NDArray, pixels: NDArray, depths: NDArray) -> Resected:
        """The pose of a frame that sees these points (N, 3); relative depth has an unknown scale and does not count."""
        inverse, sigma = self.measured(ids, depths)
        if self.camera.depth_is_relative:
            sigma[:, 1] = np.inf
        return refined_pose(self.camera.matrix, start, points, pixels, inverse, sigma, self.weight[ids])

    def of_frames(self, frames: list[int], scales: NDArray) -> tuple[NDArray[np.int32], Observations]:
        """Points seen in two frames or more, and their observations. Args: scales: (T,) of the depth of all frames."""
        ids, numbers = np.concatenate([self.ids[f] for f in frames]), [len(self.ids[f]) for f in frames]
        camera, scale = np.repeat(np.arange(len(frames)), numbers), np.repeat(scales[frames], numbers)
        pixels = np.concatenate([self.pixels[f] for f in frames]).astype(np.float64)
        depths = np.concatenate([self.depths[f] for f in frames])
        number = np.bincount(ids, minlength=self.count)
        keep = (number[ids] >= 2) & ~self.held_out(ids)
        ids, camera, pixels, depths, scale = ids[keep], camera[keep], pixels[keep], depths[keep], scale[keep]
        inverse, sigma = self.measured(ids, depths * scale.astype(np.float32))
        if self.camera.depth_is_relative:
            # The depth of one place is wrong in the same way in every frame: all of them count as one measurement.
            sigma[:, 1] *= np.sqrt(number[ids])
        points, point = np.unique(ids, return_inverse=True)
        return points, Observations(camera, point, pixels, inverse, sigma)
