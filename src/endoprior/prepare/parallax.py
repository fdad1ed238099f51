"""Depth of all frames of a clip from the motion of its camera: measured, checked, and filled by an initial estimate.

Each frame is measured with its partners, then checked against what they measured and filled, then made steady.

A measured depth is sure where its partners, measured on their own, see the same surface. Tissue or a tool that moves by
itself has another depth for every pair of frames, so it agrees with few of them.

The initial depth, which says how depth goes on from what is measured, is bent to it. What the logarithm of the depth
lacks at confident pixels is spread over their neighborhood by successive corrections (Barnes 1964), from wide to
narrow; what is left is added where it was measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import SURE_DEPTH
from ..system.memory import BoundedCache, cache_bytes
from ..system.parallel import frame_threads
from .camera_path.tracks import FrameReader, PoseInput, TrackingCamera
from .camera_path.views import HighPassImage, Warp, choose_partners, scaled_size
from .plane_sweep import FINE_WIDTH, Shot, Sweep

TOLERANCE = 0.02  # relative difference of two measured depths that halves their agreement
MATCH_PX = 0.25  # standard deviation of a match, px of a fine view
NEEDED = 2.0  # agreement, summed over the partners, from which a depth is sure
SUPPORT, SUPPORT_PX = 0.3, 5.0
"""Mean confidence of a neighborhood from which it supports a pixel, and its standard deviation, px of a fine view: what
is sure alone among what is not has met its like by chance."""
REACHES = (1 / 3, 1 / 6, 1 / 12, 1 / 24, 1 / 48, 1 / 96)  # standard deviations, as shares of the width
DOUBT = 0.05  # weight of no change beside that of pixels that are sure
MIN_CONFIDENCE = 0.1  # confidence below which a pixel does not speak
SAME = 0.1  # difference of log depth that halves the weight of another frame: beyond, it shows another surface
MAX_INITIAL_RATIO = 3.0  # of a measured depth to the initial one, after one factor for the frame; above, a chance match
MIN_MEASURED_SHARE = 0.15  # of the tissue that is measured, below which the path does not tell the depth
MIN_FRAME_SHARE = 0.5  # share of the frames that have partners, below which the camera moves too little
BYTES_PER_PX = 400  # memory in which a thread measures a frame, bytes for each px of a fine view
AROUND = 4  # frames on each side with which the depth of a frame is averaged


@dataclass(frozen=True)
class ParallaxDepth:
    """What the motion of the camera says of the depth of `T` frames, at a small size (h, w)."""

    factor: NDArray[np.float32]  # (T, h, w) that brings the initial depth to the measured one, in the unit of the path
    confidence: NDArray[np.uint8]  # (T, h, w) 0 to 255
    share: float  # of the tissue that is measured
    frames: float  # share of the frames that have partners

    def depth(self, index: int, initial: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) depth of a frame: the initial one (H, W) bent to what is measured; 0 stays."""
        factor = cv2.resize(self.factor[index], initial.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return np.asarray(initial * factor, np.float32)

    def confidence_of(self, index: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        """(H, W) confidence of a frame of `size` (W, H), 0 to 255."""
        return np.asarray(cv2.resize(self.confidence[index], size, interpolation=cv2.INTER_LINEAR), np.uint8)

    @property
    def doubt(self) -> str:
        """Why it is no answer; empty if it is one."""
        if self.frames < MIN_FRAME_SHARE:
            return f"the camera moves too little beside {1 - self.frames:.0%} of the frames"
        if self.share < MIN_MEASURED_SHARE:
            return f"parallax and path agree on {self.share:.0%} of the tissue"
        return ""


def measure_depth(
    frames: FrameReader,
    camera: TrackingCamera,
    world_to_camera: NDArray[np.float64],
    usable: NDArray[np.bool_],
    folder: Path,
    progress: Callable[[int], None] = lambda _done: None,
) -> ParallaxDepth:
    """Measure the depth of all frames.

    Args:
        frames: with depth that is bent to what is measured, in the unit of the path.
        world_to_camera: (T, 4, 4). usable: (T,) whether a frame has a pose of its own.
        folder: for files of all frames, 19 bytes for each pixel of a small frame; made if it is not there.
        progress: is told the number of frames measured.
    """
    count, size, small = frames.count, camera.size, scaled_size(camera.size, FINE_WIDTH)
    everything, shape = range(count), small[::-1]
    folder.mkdir(exist_ok=True)

    def stored(name: str, kind: type) -> NDArray:
        """Numbers of all frames, which may not fit into memory."""
        return np.lib.format.open_memmap(folder / f"{name}.npy", "w+", kind, (count, *shape))

    measured, scores = stored("inverse_depth", np.float32), stored("correlation", np.float16)
    initial, filled, factor = (stored(name, np.float32) for name in ("initial", "depth", "factor"))
    confidence, (distance, tissue_px, shares) = stored("confidence", np.uint8), np.zeros((3, count))
    with frame_threads(BYTES_PER_PX * shape[0] * shape[1]) as pool:
        for i, found in zip(everything, pool.map(lambda i: _initial(frames.frame(i), small), everything), strict=True):
            initial[i], distance[i], tissue_px[i] = found
        usable = usable & np.isfinite(distance)
        partners = choose_partners(world_to_camera, camera.matrix, size, np.where(usable, distance, 1.0), usable)
        sweep = Sweep.of(camera.matrix, size, float(np.median(distance[usable])) if usable.any() else 1.0)
        clip = _Clip(frames, initial, world_to_camera, usable, partners, sweep)
        for i, found in zip(everything, pool.map(clip.measured, everything), strict=True):
            if found is not None:
                measured[i], scores[i] = found
            progress(i + 1)
        for i, found in zip(everything, pool.map(lambda i: clip.filled(i, measured, scores), everything), strict=True):
            filled[i], confidence[i] = found[0], np.round(255 * found[1])
            shares[i] = (found[1] > SURE_DEPTH).sum() / max(tissue_px[i], 1.0)
        for i, found in zip(everything, pool.map(lambda i: clip.factor(i, filled), everything), strict=True):
            factor[i] = found
    share = float(shares[usable].mean()) if usable.any() else 0.0
    return ParallaxDepth(factor, confidence, share, np.mean([bool(each) for each in partners]).item())


class _Clip:
    """The frames of a clip, one at a time."""

    def __init__(
        self, frames: FrameReader, initial: NDArray, poses: NDArray, usable: NDArray,
        partners: list[tuple[int, ...]], sweep: Sweep,
    ) -> None:  # fmt: skip
        self._frames, self._initial_depth, self._poses, self._usable = frames, initial, poses, usable
        self._partners, self._sweep = partners, sweep
        self._views: BoundedCache[HighPassImage] = BoundedCache(cache_bytes(), lambda view: view.detail.nbytes * 2)

    def view(self, i: int) -> HighPassImage:
        def seen() -> HighPassImage:
            return HighPassImage.of(self._frames.color(i), self._frames.tissue(i), self._sweep.size)

        return self._views.get(i, seen)

    def measured(self, i: int) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """`Sweep.inverse_depth` of a frame; None without partners."""
        others = self._partners[i]
        shots = [Shot(self.view(j), self._poses[j]) for j in (i, *others)]
        return self._sweep.inverse_depth(shots[0], shots[1:]) if others else None

    def filled(self, i: int, measured: NDArray, scores: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(h, w) depth of a frame, filled, and its confidence."""
        initial, others = np.asarray(self._initial_depth[i]), [j for j in self._partners[i] if self._partners[j]]
        if not others:
            return initial, np.zeros_like(initial)
        inverse, confidence = checked(measured[i], scores[i], self._warps(i, others), [measured[j] for j in others])
        confidence *= self.view(i).usable
        return initial * bent(initial, inverse, confidence), confidence

    def factor(self, i: int, filled: NDArray) -> NDArray[np.float32]:
        """(h, w) factor of the initial depth, with the depth of the frames around averaged."""
        near = range(max(i - AROUND, 0), min(i + AROUND + 1, len(self._poses)))
        others = [j for j in near if j != i and self._usable[i] and self._usable[j]]
        depth, initial = steady(filled[i], self._warps(i, others), [filled[j] for j in others]), self._initial_depth[i]
        return np.divide(depth, initial, out=np.ones_like(depth), where=initial > 0)

    def _warps(self, i: int, others: Sequence[int]) -> list[Warp]:
        sweep = self._sweep
        return [Warp.between(sweep.matrix, self._poses[i], self._poses[j], sweep.size) for j in others]


def _initial(seen: PoseInput, size: tuple[int, int]) -> tuple[NDArray[np.float32], float, float]:
    """A frame at `size` (w, h): initial depth (h, w), the middle of that on tissue, NaN where none has depth, and
    the number of pixels of tissue.
    """
    there = seen.tissue_mask & (seen.depth > 0)
    middle = float(np.median(seen.depth[there])) if there.any() else np.nan
    initial = np.asarray(cv2.resize(seen.depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
    return initial, middle, float(seen.tissue_mask.mean()) * size[0] * size[1]


def checked(
    inverse: NDArray[np.float32],
    score: NDArray[np.float32],
    warps: Sequence[Warp],
    others: Sequence[NDArray[np.float32]],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) inverse depth, averaged with that of the partners that agree, and (h, w) confidence in [0, 1].

    Confidence is the product of four terms: agreement, sum over the partners of 1 / (1 + (difference / 2 %)^2), of two
    that are needed; precision, 1 / (1 + (error of a match / 2 %)^2) with the depth error that `MATCH_PX` makes; the
    correlation of the images; and the support of the neighborhood.

    Args:
        inverse, score: (h, w) of the frame, see `Sweep.inverse_depth`.
        warps, others: to each partner, and (h, w) its own inverse depth.
    """
    total, weight = inverse.copy(), np.ones_like(inverse)
    agreement, precision = np.zeros_like(inverse), np.zeros_like(inverse)
    for warp, other in zip(warps, others, strict=True):
        x, y, expected = warp.at(inverse)
        seen = cv2.remap(other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        ratio = seen / np.maximum(expected, np.float32(1e-9))
        agrees = np.where(seen > 0, 1 / (1 + ((ratio - 1) / TOLERANCE) ** 2), 0).astype(np.float32)
        total += agrees * ratio * inverse
        weight += agrees
        agreement += agrees
        nearer_x, nearer_y, _ = warp.at(inverse * np.float32(1 + TOLERANCE))
        shift_px = np.hypot(nearer_x - x, nearer_y - y)
        precision = np.maximum(precision, 1 / (1 + (MATCH_PX / np.maximum(shift_px, 1e-6)) ** 2))
    sure = np.minimum(agreement / NEEDED, 1)
    alone = (sure * precision * np.clip(score, 0, 1)).astype(np.float32)
    support = np.minimum(cv2.GaussianBlur(alone, (0, 0), SUPPORT_PX) / np.float32(SUPPORT), 1)
    return total / weight, alone * support


def bent(
    initial: NDArray[np.float32], inverse: NDArray[np.float32], confidence: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(h, w) factor that brings the initial depth to the measured one.

    Args:
        initial: (h, w) depth, 0 where it is missing. inverse: (h, w) measured inverse depth.
        confidence: (h, w) of what was measured, in [0, 1].
    """
    weight = np.where((initial > 0) & (confidence > MIN_CONFIDENCE), confidence**2, 0).astype(np.float32)
    left = -np.log(np.maximum(inverse * np.where(initial > 0, initial, 1), np.float32(1e-6))).astype(np.float32)
    field = np.full_like(left, _median(left, weight))
    left = np.clip(left - field, -np.log(MAX_INITIAL_RATIO), np.log(MAX_INITIAL_RATIO)).astype(np.float32)
    for reach in REACHES:
        sigma = reach * initial.shape[1]
        spread = cv2.GaussianBlur(left * weight, (0, 0), sigma) / (cv2.GaussianBlur(weight, (0, 0), sigma) + DOUBT)
        field, left = field + spread, left - spread
    return np.exp(field)


def steady(
    depth: NDArray[np.float32], warps: Sequence[Warp], others: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """(h, w) depth of a frame, averaged with what frames around it have there: noise of single frames would shake it.

    Args:
        depth: (h, w), 0 where it is missing. warps, others: to each frame around it, and (h, w) its depth.
    """
    inverse = np.reciprocal(np.maximum(depth, np.float32(1e-6)))
    total, weight = np.zeros_like(depth), np.ones_like(depth)
    for warp, other in zip(warps, others, strict=True):
        x, y, expected = warp.at(inverse)
        seen = cv2.remap(other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        change = np.log(np.maximum(seen * expected, np.float32(1e-6)))
        agrees = np.where(seen > 0, 1 / (1 + (change / np.float32(SAME)) ** 2), 0)
        total += agrees * change
        weight += agrees
    return depth * np.exp(total / weight)


def _median(values: NDArray, weight: NDArray) -> float:
    """Weighted median; 0 without any weight."""
    order = np.argsort(values, axis=None)
    share = np.cumsum(weight.ravel()[order], dtype=np.float64)
    return float(values.flat[order[np.searchsorted(share, share[-1] / 2)]]) if share[-1] > 0 else 0.0
