"""A frame in which places are compared: without shading, without what is not tissue; and where other cameras see it.

The lamp moves with the camera, and brightness falls with distance: of two frames, not the brightness of a place is
alike but its detail. Highlights move over the tissue, and do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...priors.specular import specular_likelihood

DETAIL = 1 / 24  # standard deviation of what counts as shading, as a share of the width
DARKEST = 4.0 / 255  # darker pixels are noise
USABLE = 0.99  # least share of a small pixel that is usable
HIGHLIGHT = 0.5  # likelihood from which a pixel is a highlight


@dataclass(frozen=True)
class EvenView:
    """A small frame (h, w)."""

    detail: NDArray[np.float32]
    """(h, w) logarithm of the brightness without its low frequencies; 0 where it is not usable."""
    usable: NDArray[np.float32]
    """(h, w) 1 on tissue without highlights, else 0."""

    @classmethod
    def of(cls, rgb_u8: NDArray[np.uint8], tissue_mask: NDArray[np.bool_], size: tuple[int, int]) -> EvenView:
        """The view of a frame (H, W, 3) with its tissue (H, W), at `size` (w, h)."""
        counts = tissue_mask & (specular_likelihood(rgb_u8 * np.float32(1 / 255)) < HIGHLIGHT)
        share = cv2.resize(counts.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        usable = (share > USABLE).astype(np.float32)
        gray = cv2.cvtColor(cv2.resize(rgb_u8, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        log = np.log(np.maximum(gray * np.float32(1 / 255), np.float32(DARKEST)))
        sigma = DETAIL * size[0]
        weight = np.maximum(cv2.GaussianBlur(usable, (0, 0), sigma), 1e-3)
        detail = usable * (log - cv2.GaussianBlur(log * usable, (0, 0), sigma) / weight)
        return cls(np.asarray(detail, np.float32), usable)

    def resized(self, size: tuple[int, int]) -> EvenView:
        """The view at a smaller size (w, h)."""
        usable = cv2.resize(self.usable, size, interpolation=cv2.INTER_AREA)
        detail = cv2.resize(self.detail, size, interpolation=cv2.INTER_AREA)
        return EvenView(np.asarray(detail, np.float32), (usable > USABLE).astype(np.float32))


@dataclass(frozen=True)
class Warp:
    """Where a second camera sees the pixels of a first one, at any inverse depth.

    The pixel x of inverse depth w lies at (a + w b), in homogeneous coordinates, with a = K R K^-1 x and b = K t.
    """

    a: NDArray[np.float32]  # (3, h, w)
    b: NDArray[np.float32]  # (3,)

    @classmethod
    def between(
        cls, matrix: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64], size: tuple[int, int]
    ) -> Warp:
        """From the first camera to the second.

        Args:
            matrix: (3, 3) K of images of `size` (w, h), px; the left-most pixel is centered at 0.
            first, second: (4, 4) world to camera.
        """
        turn = second[:3, :3] @ first[:3, :3].T
        shift = second[:3, 3] - turn @ first[:3, 3]
        x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        pixels = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
        rays = matrix @ turn @ np.linalg.inv(matrix) @ pixels
        return cls(rays.reshape(3, *x.shape).astype(np.float32), (matrix @ shift).astype(np.float32))

    def at(self, inverse: NDArray[np.float32] | np.float32) -> tuple[NDArray, NDArray, NDArray]:
        """(h, w) x and y of the pixels in the second camera, px, and their inverse depth there.

        Args:
            inverse: (h, w) inverse depth in the first camera, or one for all pixels, above 0.
        """
        z = np.maximum(self.a[2] + self.b[2] * inverse, np.float32(1e-3))
        return (self.a[0] + self.b[0] * inverse) / z, (self.a[1] + self.b[1] * inverse) / z, inverse / z


def matrix_at(matrix: NDArray[np.float64], size: tuple[int, int], small: tuple[int, int]) -> NDArray[np.float64]:
    """K of an image resized to `small`, with the left-most pixel centered at 0, as it is of the larger image."""
    out = np.array(matrix, np.float64)
    out[:2, 2] += 0.5
    out[:2] *= (np.array(small) / np.array(size))[:, None]
    out[:2, 2] -= 0.5
    return out
