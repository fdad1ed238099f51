"""Depth of all frames of a clip from the motion of its camera: measured, checked, and filled by a guess.

Frames are independent of each other: each is measured with its partners, then checked against what they measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...system.memory import BoundedCache, cache_bytes
from ...system.parallel import frame_threads
from ..camera_path.tracks import PoseInput
from .consistency import checked
from .filling import bent
from .partners import choose_partners
from .sweep import FINE_WIDTH, Shot, Sweep
from .views import View, Warp

SURE = 0.4  # confidence of a pixel that counts as measured
LEAST_SHARE = 0.1  # of the tissue that is measured, below which the path does not tell the depth
LEAST_FRAMES = 0.5  # share of the frames that have partners, below which the camera moves too little
BYTES_PER_PX = 400  # memory in which a thread measures a frame, bytes for each px of a fine view
MEASURED, SCORES, CHECKED, SURENESS = "inverse_depth.npy", "correlation.npy", "checked.npy", "confidence.npy"
"""Files with numbers of all frames, while at work."""


@dataclass(frozen=True)
class ParallaxDepth:
    """Depth of `T` frames from parallax, in the unit of the path."""

    inverse: NDArray[np.float32]  # (T, h, w)
    confidence: NDArray[np.uint8]  # (T, h, w) 0 to 255
    share: float  # of the tissue that is measured
    frames: float  # share of the frames that have partners

    def filled(self, index: int, guess: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) depth of a frame: the guess (H, W) bent to what is measured; 0 stays."""
        inverse, confidence = self.inverse[index], self.confidence[index] / np.float32(255)
        height, width = inverse.shape
        small = np.asarray(cv2.resize(guess, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
        factor = cv2.resize(bent(small, inverse, confidence), guess.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return np.asarray(guess * factor, np.float32)

    def sureness(self, index: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        """(H, W) confidence of a frame of `size` (W, H), 0 to 255."""
        return np.asarray(cv2.resize(self.confidence[index], size, interpolation=cv2.INTER_LINEAR), np.uint8)

    @property
    def doubt(self) -> str:
        """Why it is no answer; empty if it is one."""
        if self.frames < LEAST_FRAMES:
            return f"the camera moves too little beside {1 - self.frames:.0%} of the frames"
        if self.share < LEAST_SHARE:
            return f"parallax and path agree on {self.share:.0%} of the tissue"
        return ""


def measure_depth(
    frame: Callable[[int], PoseInput],
    world_to_camera: NDArray[np.float64],
    usable: NDArray[np.bool_],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
    folder: Path,
    progress: Callable[[int], None] = lambda _done: None,
) -> ParallaxDepth:
    """Measure the depth of all frames.

    Args:
        frame: reads frame i, its depth in the unit of the path; of depth only the middle counts.
        world_to_camera: (T, 4, 4). usable: (T,) whether a frame has a pose of its own.
        matrix: (3, 3) K, px; the left-most pixel is centered at 0. size: (width, height), px.
        folder: for files of all frames, 11 bytes for each pixel of a small frame; made if it is not there.
        progress: is told the number of frames measured.
    """
    count = len(world_to_camera)
    distance = np.array([_distance(frame(i)) for i in range(count)])
    usable = usable & np.isfinite(distance)
    partners = choose_partners(world_to_camera, matrix, size, np.where(usable, distance, 1.0), usable)
    middle = float(np.median(distance[usable])) if usable.any() else 1.0
    sweep = Sweep.of(matrix, size, middle)
    width, height = sweep.size
    folder.mkdir(exist_ok=True)
    shape = (count, height, width)
    measured = np.lib.format.open_memmap(folder / MEASURED, "w+", np.float32, shape)
    scores = np.lib.format.open_memmap(folder / SCORES, "w+", np.float16, shape)
    confirmed = np.lib.format.open_memmap(folder / CHECKED, "w+", np.float32, shape)
    sureness = np.lib.format.open_memmap(folder / SURENESS, "w+", np.uint8, shape)
    views: BoundedCache[View] = BoundedCache(cache_bytes(), lambda view: view.detail.nbytes + view.usable.nbytes)

    def shot(i: int) -> Shot:
        def view() -> View:
            seen = frame(i)
            return View.of(seen.rgb_u8, seen.tissue_mask, sweep.size)

        return Shot(views.get(i, view), world_to_camera[i])

    def measure(i: int) -> tuple[int, tuple[NDArray, NDArray] | None]:
        return i, sweep.inverse_depth(shot(i), [shot(j) for j in partners[i]]) if partners[i] else None

    def check(i: int) -> tuple[int, tuple[NDArray, NDArray] | None, float]:
        others = [j for j in partners[i] if partners[j]]
        if not others:
            return i, None, 0.0
        warps = [Warp.between(sweep.matrix, world_to_camera[i], world_to_camera[j], sweep.size) for j in others]
        inverse, confidence = checked(measured[i], scores[i], warps, [measured[j] for j in others])
        tissue = shot(i).view.usable
        return i, (inverse, confidence * tissue), float((confidence > SURE)[tissue > 0].mean()) if tissue.any() else 0.0

    shares = np.zeros(count)
    with frame_threads(BYTES_PER_PX * FINE_WIDTH * height) as pool:
        for i, found in pool.map(measure, range(count)):
            if found is not None:
                measured[i], scores[i] = found
            progress(i + 1)
        for i, found, share in pool.map(check, range(count)):
            shares[i] = share
            if found is not None:
                confirmed[i], sureness[i] = found[0], np.round(255 * found[1])
    share = float(shares[usable].mean()) if usable.any() else 0.0
    return ParallaxDepth(confirmed, sureness, share, np.mean([bool(each) for each in partners]).item())


def _distance(seen: PoseInput) -> float:
    """Middle distance of the tissue of a frame; NaN where none has depth."""
    there = seen.tissue_mask & (seen.depth > 0)
    return float(np.median(seen.depth[there])) if there.any() else np.nan
