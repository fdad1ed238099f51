"""Look through a whole video once, quickly: what its images show, and where it is cut. Memory does not grow with it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..footage.disturbances import FrameQuality, disturbances, measure_quality, scenes_outside, small_size, view_mask
from ..footage.image_operations import Image, runs
from ..footage.scenes import (
    JUMP,
    REACH,
    THUMB_WIDTH,
    GlobalMotion,
    ImageFeatures,
    breaks,
    change,
    connected,
    jumps,
    motion_by_features,
    motion_by_flow,
    places_differ,
    standardized,
)
from .source import open_source, quick_images

NUM_FRAMES, RATES = 2400, (2.0, 10.0)
"""So many images are measured, if that is not less or more than these rates, 1/s."""
NUM_SAMPLE_IMAGES = 24  # images that show which part of the frame is the endoscope's image
BACK_S = 3.0  # tissue is looked for in the images of so long before, s
BACK = (1, 2, 5, 12, 28)  # how many images before; each costs a comparison of features
FROZEN = 0.12  # images are the same if their mean difference is below this, levels of 255
GAP_S = 0.5  # a shorter stretch of clear images between disturbed ones does not count, s
FROZEN_S = 1.0  # so long that video counts as a still image, s
OUTSIDE, FROZEN_WORDS = "out of the body", "repeated frames"


@dataclass(frozen=True)
class ScannedFrame:
    """One image that was measured."""

    seconds: float  # since the first image
    quality: FrameQuality
    motion: GlobalMotion | None  # of the image as a whole since an image before; None: unknown
    word: str = ""  # what is wrong with it; empty for nothing
    weight: float = 1.0  # how far it is to be believed, in [0, 1]


@dataclass(frozen=True)
class Scan:
    """What a video shows."""

    seconds: float  # duration
    rate: float  # frames measured a second, at most
    frames: list[ScannedFrame]
    cuts: list[float]  # times of the first images after cuts, s
    pictures: list[Image]  # a few small images (h, w, 3), evenly spaced


def scan_video(
    video: Path, folder_rate: float | None = None, progress: Callable[[float, float], None] = lambda _done, _all: None
) -> Scan:
    """Look through a video.

    Args:
        folder_rate: frame rate of a folder of images, 1/s; None: as it says itself, or assumed.
        progress: called with the seconds done, and all.
    Raises:
        InputError: it cannot be opened.
    """
    source = open_source(video, folder_rate)
    size = small_size(source.width, source.height)
    pictures = [
        np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.uint8)
        for each in source.sample_images(0.0, source.seconds, NUM_SAMPLE_IMAGES)
    ]
    inside = view_mask(pictures)
    rate = float(np.clip(NUM_FRAMES / max(source.seconds, 1e-3), *RATES))
    watch, frames, frozen = _Watch(inside, rate), list[ScannedFrame](), list[float]()
    times, changes, positions = list[float](), list[float](), list[int]()  # of every image; frames before each
    thumbs, refuted, before = deque[NDArray[np.float32]](maxlen=2 * REACH), set[int](), None
    for seconds, image in quick_images(source):
        now = standardized(image(THUMB_WIDTH, max(round(THUMB_WIDTH * size[1] / size[0]), 1), is_gray=True))
        times.append(seconds)
        changes.append(change(thumbs[-1], now) if thumbs else 0.0)
        positions.append(len(frames))
        thumbs.append(now)
        if len(changes) >= REACH and changes[-REACH] > JUMP:
            around = list(thumbs)
            if not places_differ(around[:-REACH], around[-REACH:]):
                refuted.add(len(changes) - REACH)
        if frames and seconds < frames[-1].seconds + 1 / rate - 1e-6:
            continue
        small = image(*size)
        frozen.append(np.inf if before is None else float(cv2.absdiff(small, before).mean()))
        before = small
        motion = watch.motion(np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8))
        frames.append(ScannedFrame(seconds, measure_quality(small, inside), motion))
        progress(seconds, source.seconds)
    sudden = np.zeros(len(frames) + 1, bool)
    first_after = np.full(len(frames) + 1, np.inf)
    for i in set(np.flatnonzero(jumps(np.array(times), np.array(changes))).tolist()) - refuted:
        sudden[positions[i]] = True
        first_after[positions[i]] = min(first_after[positions[i]], times[i])
    is_cut = breaks(len(frames), watch.pairs) & sudden[: len(frames)]
    cuts = [float(first_after[i]) for i in np.flatnonzero(is_cut)]
    duration = max(source.seconds, times[-1] if times else 0.0)
    return Scan(
        duration,
        rate,
        _with_disturbances(frames, is_cut, connected(len(frames), watch.pairs), np.array(frozen) < FROZEN, rate),
        cuts,
        pictures,
    )


def _with_disturbances(
    frames: list[ScannedFrame],
    is_cut: NDArray[np.bool_],
    place: NDArray[np.integer],
    same: NDArray[np.bool_],
    rate: float,
) -> list[ScannedFrame]:
    """The frames with what is wrong with each.

    Args:
        place: a number for each set of frames of the same tissue. same: whether a frame repeats the one before.
    """
    seconds, measured = np.array([frame.seconds for frame in frames]), [frame.quality for frame in frames]
    scene = np.cumsum(is_cut, dtype=np.int64)
    words, weights = disturbances(seconds, measured, scene)
    outside = scenes_outside(measured, place)
    for i in range(len(frames)):
        if place[i] in outside:
            words[i], weights[i] = OUTSIDE, 0.0
    for first, end in runs(np.array(words) == ""):  # a clear image between two of the same smoke is in it
        lasts = seconds[min(end, len(frames) - 1)] - seconds[first]
        if 0 < first and end < len(frames) and lasts < GAP_S and scene[first - 1] == scene[end]:
            words[first:end] = [words[first - 1]] * (end - first)
    for first, end in runs(same):
        if seconds[end - 1] - seconds[first] >= FROZEN_S - 1 / rate:
            words[first:end] = [word or FROZEN_WORDS for word in words[first:end]]
    return [
        replace(frame, word=word, weight=float(weight))
        for frame, word, weight in zip(frames, words, weights, strict=True)
    ]


class _Watch:
    """Finds the tissue of each image in the images before."""

    def __init__(self, inside: NDArray[np.bool_], rate: float) -> None:
        self.pairs: list[tuple[int, int]] = []  # positions of images that show the same tissue
        self._inside, self._count = inside, 0
        self._views = deque[ImageFeatures](maxlen=max(int(BACK_S * rate), 1))

    def motion(self, gray: NDArray[np.uint8]) -> GlobalMotion | None:
        """How the tissue moved since an earlier image."""
        now, found = ImageFeatures(gray, self._inside), None
        for back in (each for each in BACK if each <= len(self._views)):
            before = self._views[-back]
            found = (motion_by_flow(before, now) if back == 1 else None) or motion_by_features(before, now)
            if found is not None:
                self.pairs.append((self._count - back, self._count))
                break
        self._views.append(now)
        self._count += 1
        return found
