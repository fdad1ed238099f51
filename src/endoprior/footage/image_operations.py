"""Types of images and masks, and operations on them by OpenCV: channels, connected regions, dilation, distances."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]  # Color (H, W, 3) or gray (H, W), 0..255
Item = TypeVar("Item")
Result = TypeVar("Result")
LEFT, TOP, WIDTH, HEIGHT, AREA = range(5)  # Columns of the boxes of `components`


class InOrder(Protocol):
    """As `map`: what a function gives for each item, in order. Threads may call it for several items at a time."""

    def __call__(self, function: Callable[[Item], Result], items: Iterable[Item], /) -> Iterator[Result]: ...


def largest_channel(image: Image) -> Image:
    """(H, W) of an image (H, W, 3)."""
    red, green, blue = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(red, green), blue), np.uint8)


def smallest_channel(image: Image) -> Image:
    """(H, W) of an image (H, W, 3)."""
    red, green, blue = cv2.split(image)
    return np.asarray(cv2.min(cv2.min(red, green), blue), np.uint8)


def components(mask: Mask, connectivity: int = 8) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(H, W) number of each pixel's connected region, 0 outside of `mask`; (count, 5) box and area of each region."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=connectivity)
    return np.asarray(labels, np.int32), np.asarray(boxes, np.int32)


def regions_where(keep: NDArray[np.bool_], labels: NDArray[np.int32]) -> Mask:
    """(H, W) True on the regions of `components` that are to be kept, (count,); never outside of the mask."""
    return (keep & (np.arange(len(keep)) > 0))[labels]


def large_regions(mask: Mask, least_px: float, connectivity: int = 8) -> Mask:
    """(H, W) the mask without regions of fewer pixels."""
    labels, boxes = components(mask, connectivity)
    return regions_where(boxes[:, AREA] >= least_px, labels)


def dilated(mask: Mask, kernel: NDArray[np.uint8]) -> Mask:
    """(H, W) True where the kernel, centered there, meets the mask."""
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


def distance_inside(mask: Mask) -> NDArray[np.float32]:
    """(H, W) distance of each True pixel to the nearest False one, px; 0 on False ones."""
    found = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(found, np.float32)


def square(reach: int) -> NDArray[np.uint8]:
    """Structuring element that reaches so many px to each side."""
    return np.ones((2 * reach + 1,) * 2, np.uint8)


def disk(radius: int) -> NDArray[np.uint8]:
    """Structuring element of that radius, px."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def runs(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(first, end) of each stretch of True values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
