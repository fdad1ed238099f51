"""Detect changes that tissue motion does not cause: duplicates, exposure jumps, cuts, blur, views outside the body.

`T` successive images of one clip. Changes are measured on thumbnails, which suppresses noise. Each detector takes what
it needs of the images, in order, and gives the positions, from 0, of those that it finds. Its limits stand above it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .disturbances import FrameQuality, disturbances, measure_quality, small_size
from .image_operations import Image, InOrder, runs
from .scenes import REACH, ImageFeatures, change, jumps, places_differ, same_view, standardized
from .scenes import THUMB_WIDTH as SCENE_WIDTH

Gray = NDArray[np.float32]
"""(h, w) gray levels of a thumbnail, 0..255."""
THUMB_WIDTH = 160  # Images are compared at this width, px
NEIGHBORS = 5  # Number of images on each side that define the usual value
USUAL_RATE = 25.0  # Frame rate, 1/s, which decides how many images around an image it is compared with


@dataclass(frozen=True)
class Changes:
    """Curves over the clip, and the positions, from 0, of conspicuous images."""

    brightness: NDArray[np.float64]  # (T,) mean gray level in [0, 1]
    difference: NDArray[np.float64]  # (T - 1,) mean absolute difference of successive thumbnails, levels of 255
    sharpness: NDArray[np.float64]  # (T,) RMS of the Laplacian by brightness, > 0; comparable within one clip only
    duplicates: tuple[int, ...]  # Images that repeat the one before
    exposure_jumps: tuple[int, ...]  # Images that are suddenly brighter or darker than the one before
    cuts: tuple[int, ...]  # Images that show another view than the one before
    blurred: tuple[int, ...]  # Images much less sharp than their neighbors
    off_color: tuple[int, ...]  # Images of another color than the clip, which do not follow from it: outside the body
    weights: NDArray[np.float64]  # (T,) how far each is to be believed, in [0, 1]: 1, or less where smoke or blur lies


def find_changes(images: Iterable[Image], each: InOrder = map) -> Changes:
    """Measure the curves and detect conspicuous images, of T >= 1 images (H, W, 3) of one size; each is used once.

    Args:
        each: as `map`; threads can give the results, in order.
    """
    thumbs, shares, sharp, qualities = zip(*each(_measured, images), strict=True)
    sharpness, difference, cuts = np.array(sharp), _differences(thumbs), _cuts(thumbs)
    return Changes(
        brightness=np.array([thumb.mean() for thumb in thumbs], np.float64) / 255,
        difference=difference,
        sharpness=sharpness,
        duplicates=find_duplicates(difference),
        exposure_jumps=tuple(i for i in _exposure_jumps(thumbs) if i not in cuts),
        cuts=cuts,
        blurred=_blurred(sharpness),
        off_color=_off_color(np.array(shares), thumbs),
        weights=_weights(qualities, cuts),
    )


def find_cuts(images: Iterable[Image], each: InOrder = map) -> tuple[int, ...]:
    """`Changes.cuts` alone, in a fifth of the time. Args: as of `find_changes`."""
    return _cuts(list(each(lambda image: _gray(_thumb(image)), images)))


class _Measured(NamedTuple):
    """What is kept of one image."""

    thumb: Gray
    share: NDArray[np.float64]  # (2,) see `color_share`
    sharpness: float
    quality: FrameQuality


def _measured(image: Image) -> _Measured:
    color = _thumb(image)
    small = cv2.resize(image, small_size(image.shape[1], image.shape[0]), interpolation=cv2.INTER_AREA)
    quality = measure_quality(np.asarray(small, np.uint8), np.ones(small.shape[:2], bool))
    return _Measured(_gray(color), color_share(color), _sharpness(image), quality)


def _thumb(image: Image) -> NDArray[np.float32]:
    """(h, w, 3) the image, small."""
    size = THUMB_WIDTH, max(1, round(THUMB_WIDTH * image.shape[0] / image.shape[1]))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _gray(color: NDArray[np.float32]) -> Gray:
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.float32)


def color_share(image: NDArray) -> NDArray[np.float64]:
    """(2,) share of red and of green in the mean color of an image (H, W, 3) of 0..255."""
    mean = image.mean((0, 1), dtype=np.float64)
    return mean[:2] / max(mean.sum(), 1.0)


def _sharpness(image: Image) -> float:
    """RMS of the Laplacian at half size, divided by brightness: exposure does not change it."""
    gray = _reduced(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 0.5)
    return float(cv2.Laplacian(gray, cv2.CV_32F).std() / max(float(gray.mean()), 1.0)) + 1e-6


def _reduced(image: NDArray, share: float) -> NDArray:
    height, width = image.shape[:2]
    fx, fy = max(share, 1 / width), max(share, 1 / height)
    return cv2.resize(image, None, fx=fx, fy=fy, interpolation=cv2.INTER_AREA)


def _differences(thumbs: Sequence[Gray]) -> NDArray[np.float64]:
    """(T - 1,) `Changes.difference`."""
    return np.array([np.abs(now - before).mean() for before, now in pairwise(thumbs)], np.float64)


def _seconds(count: int) -> NDArray[np.float64]:
    """(T,) times of `count` images at the usual rate."""
    return np.arange(count) / USUAL_RATE


def _around(values: NDArray[np.floating]) -> list[NDArray[np.floating]]:
    """The values of each image and its neighbors."""
    return [values[max(0, i - NEIGHBORS) : i + NEIGHBORS + 1] for i in range(len(values))]


def _positions(found: NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(np.flatnonzero(found).tolist())


def _weights(qualities: Sequence[FrameQuality], cuts: Sequence[int]) -> NDArray[np.float64]:
    """(T,) `Changes.weights`; images are compared with those of the same scene only."""
    count = len(qualities)
    scene = np.isin(np.arange(count), cuts).cumsum()
    return disturbances(_seconds(count), qualities, scene)[1]


SAME_LEVELS = 0.03  # Images with a smaller mean difference, in levels of 255, are duplicates
COPY_LEVELS, COPY_SHARE = 0.12, 0.08
"""After video coding, so are images with a mean difference below this, if it is also below this share of the usual
difference around them. A static scene changes by at least 0.15 levels."""


def find_duplicates(difference: NDArray[np.floating]) -> tuple[int, ...]:
    """Positions of the images that repeat the one before, from `Changes.difference`."""
    # A high percentile, not the median: half of the images are duplicates if the frame rate was doubled.
    usual = np.array([np.percentile(window, 80) for window in _around(difference)])
    limit = np.maximum(SAME_LEVELS, np.minimum(COPY_LEVELS, COPY_SHARE * usual))
    return tuple(i + 1 for i in _positions(difference < limit))


JUMP = 0.13  # Smallest exposure jump: change of the logarithm of brightness (14 %) between two images
JUMP_RATIO = 6.0  # An exposure jump is this many times the usual change of brightness ...
JUMP_AGREEMENT = 0.85
"""... and this share of the image changes in the same direction. A tool that enters darkens only a part."""
BLACK, SATURATED = 8, 245  # Gray levels between which brightness is compared
MIN_COMPARED = 0.1  # Share of the image of which brightness must be comparable


def _exposure_jumps(thumbs: Sequence[Gray]) -> tuple[int, ...]:
    """Positions of the images that are suddenly brighter or darker than the one before; cuts are among them."""
    small = [_reduced(thumb, 0.25) for thumb in thumbs]
    steps = [_exposure_step(before, now) for before, now in pairwise(small)]
    if not steps:
        return ()
    changes, agreements = np.array(steps).T
    limit = max(JUMP, JUMP_RATIO * float(np.median(np.abs(changes))))
    return tuple(i + 1 for i in _positions((np.abs(changes) > limit) & (agreements > JUMP_AGREEMENT)))


def _exposure_step(before: NDArray, now: NDArray) -> tuple[float, float]:
    """Change of the logarithm of brightness, and the share of the pixels that change in its direction; 0 if unknown."""
    usable = (np.minimum(before, now) > BLACK) & (np.maximum(before, now) < SATURATED)
    if usable.mean() < MIN_COMPARED:
        return 0.0, 0.0
    ratio = np.log(now[usable] / before[usable])
    step = float(np.median(ratio))
    return step, float(np.mean(np.sign(ratio) == np.sign(step)))


ACROSS = (1, 3, 6)  # Tissue is looked for in images so far before and after what looks like a cut


def _cuts(thumbs: Sequence[Gray]) -> tuple[int, ...]:
    """Positions of the images that show another view than the one before."""
    small = _scene_thumbs(thumbs)
    steps = np.array([0.0, *(change(before, now) for before, now in pairwise(small))])
    return tuple(i for i in _positions(jumps(_seconds(len(thumbs)), steps)) if _is_cut(thumbs, small, i))


def _is_cut(thumbs: Sequence[Gray], small: Sequence[NDArray[np.float32]], first: int) -> bool:
    """Whether no tissue of before is found from image `first` on. Smoke, blur and a tool that moves are no cuts.

    Args:
        small: see `_scene_thumbs`.
    """
    if not places_differ(small[max(first - REACH, 0) : first], small[first : first + REACH]):
        return False
    befores = [first - k for k in ACROSS if k <= first]
    afters = [first - 1 + k for k in ACROSS if first - 1 + k < len(thumbs)]
    return not same_view(*([ImageFeatures(thumbs[i].astype(np.uint8)) for i in side] for side in (befores, afters)))


def _scene_thumbs(thumbs: Sequence[Gray]) -> list[NDArray[np.float32]]:
    """Thumbnails as `scenes.change` compares them."""
    size = SCENE_WIDTH, max(round(SCENE_WIDTH * thumbs[0].shape[0] / thumbs[0].shape[1]), 1)
    return [standardized(cv2.resize(thumb, size, interpolation=cv2.INTER_AREA)) for thumb in thumbs]


BLUR_RATIO = 0.45  # An image is blurred if its sharpness is below this share of that of its neighbors


def _blurred(sharpness: NDArray[np.float64]) -> tuple[int, ...]:
    """Positions of the images that are much less sharp than their neighbors."""
    usual = np.array([np.median(window) for window in _around(sharpness)])
    return _positions(sharpness < BLUR_RATIO * usual)


COLOR_DISTANCE = 0.07
"""An image shows another scene if its mean red or green share differs by this from the median of the clip."""
FOLLOWS = 0.9  # An image that follows from the one before has at least this correlation with it


def _off_color(shares: NDArray[np.float64], thumbs: Sequence[Gray]) -> tuple[int, ...]:
    """Positions of the images of another color, in runs that do not follow from the images before or lead to those
    after: white balance, smoke and blood change the color, too. Args: shares: (T, 2), see `color_share`.
    """
    is_off = np.abs(shares - np.median(shares, axis=0)).max(1) > COLOR_DISTANCE
    found = np.zeros(len(thumbs), bool)
    for first, end in runs(is_off):
        edges = [i for i in (first, end) if 0 < i < len(thumbs)]
        found[first:end] = all(_correlation(thumbs[i - 1], thumbs[i]) < FOLLOWS for i in edges)
    return _positions(found)


def _correlation(a: NDArray, b: NDArray) -> float:
    """Correlation of two thumbnails after smoothing; 1 for images without content."""
    a, b = (cv2.GaussianBlur(x, (0, 0), 2.0) for x in (a, b))
    a, b = a - a.mean(), b - b.mean()
    energy = float(np.sqrt((a * a).mean() * (b * b).mean()))
    return 1.0 if energy < 1e-3 else float((a * b).mean()) / energy
