"""Convert each layer to an (H, W, 3) 8-bit image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from ..visualization.image_tools import SOLID_ALPHA, colorize

LARGEST_DIFFERENCE = 0.25
"""Mean absolute color difference that is shown in red."""
OUTLINE = (0, 255, 255)
MASK_SHARE = 0.4
"""Share of the overlay's color over a mask."""


def fitted(image: NDArray, camera: Camera) -> NDArray:
    """An image of a frame, resized to the image size of `camera`; masks stay masks."""
    if image.shape[:2] == (camera.height, camera.width):
        return image
    if image.dtype == np.bool_:
        return cv2.resize(image.astype(np.uint8), (camera.width, camera.height), interpolation=cv2.INTER_NEAREST) > 0
    nearest = image.dtype.kind == "f"  # never interpolate between a depth and a missing one
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_AREA
    return cv2.resize(image, (camera.width, camera.height), interpolation=how)


def depth_picture(depth: NDArray, span: tuple[float, float]) -> NDArray[np.uint8]:
    """Turbo colors from the nearest to the farthest depth of `span`, mm; black where there is none."""
    return colorize(depth, *span, depth > 0)


def value_picture(value: NDArray, known: NDArray) -> NDArray[np.uint8]:
    """Turbo colors of composited values in [0, 1].

    Args:
        value: (H, W) composited values of the Gaussians whose value is known.
        known: (H, W) alpha of these alone; black where it is low: no surface, or nothing known of it.
    """
    return colorize(value / np.maximum(known, 1e-6), 0, 1, known > SOLID_ALPHA)


def difference_picture(rendered: NDArray[np.uint8], original: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Turbo colors of the mean absolute difference of two (H, W, 3) images."""
    difference = cv2.absdiff(rendered, original).mean(-1) / 255
    return colorize(difference, 0, LARGEST_DIFFERENCE)


def with_tool(
    picture: NDArray[np.uint8], original: NDArray[np.uint8], tissue_mask: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """A copy with the tool of the original image on top, outlined."""
    picture = np.where(tissue_mask[..., None], picture, original)
    return outlined(picture, ~tissue_mask)


def with_mask(picture: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A copy of an (H, W, 3) image with a mask (H, W) in a transparent color, outlined."""
    picture = picture.copy()
    picture[mask] = (1 - MASK_SHARE) * picture[mask] + MASK_SHARE * np.array(OUTLINE)
    return outlined(picture, mask)


def outlined(picture: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The image (H, W, 3), with the outline of a mask (H, W) drawn into it."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, OUTLINE, 1)
    return picture
