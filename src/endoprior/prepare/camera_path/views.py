"""Frames that are compared directly, without tracks between them: which ones, as what, and where one sees another.

Partners of a frame see the same tissue from another side, and soon. Parallax is the angle between the rays of two
cameras to one point. Little of it measures poorly; much of it changes how tissue looks; and the longer the time between
two frames, the further tissue has moved by itself.

Places are compared without shading, and without what is not tissue. The lamp moves with the camera, and brightness
falls with distance: of two frames, not the brightness of a place is alike but its detail. Highlights move over the
tissue, and do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...priors.specular import specular_likelihood

MIN_DEGREES, WANTED_DEGREES, MAX_DEGREES = 2.0, 5.0, 12.0
"""Median parallax below which a frame is no partner, at which the first one in time is taken, above which none is."""
SECOND = 0.6  # share of `WANTED_DEGREES` of the second partner on each side: it tells motion of tissue from depth
REACH = 60  # frames on each side in which partners are searched
OVERLAP = 0.5  # least share of probed points that a partner sees
PROBES = (-0.6, 0.0, 0.6)  # places of the probed points, as shares of half the width and of half the height
DETAIL = 1 / 24  # standard deviation of what counts as shading, as a share of the width
DARKEST = 4.0 / 255  # darker pixels are noise
USABLE = 0.99  # least share of a small pixel that is usable
HIGHLIGHT = 0.5  # likelihood from which a pixel is a highlight


@dataclass(frozen=True)
class HighPassImage:
    """A small frame (h, w)."""

    detail: NDArray[np.float32]
    """(h, w) logarithm of the brightness without its low frequencies; 0 where it is not usable."""
    usable: NDArray[np.float32]
    """(h, w) 1 on tissue without highlights, else 0."""

    @classmethod
    def of(cls, rgb_u8: NDArray[np.uint8], tissue_mask: NDArray[np.bool_], size: tuple[int, int]) -> HighPassImage:
        """That of a frame (H, W, 3) with its tissue (H, W), at `size` (w, h)."""
        counts = tissue_mask & (specular_likelihood(rgb_u8 * np.float32(1 / 255)) < HIGHLIGHT)
        share = cv2.resize(counts.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        usable = (share > USABLE).astype(np.float32)
        gray = cv2.cvtColor(cv2.resize(rgb_u8, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        log = np.log(np.maximum(gray * np.float32(1 / 255), np.float32(DARKEST)))
        sigma = DETAIL * size[0]
        weight = np.maximum(cv2.GaussianBlur(usable, (0, 0), sigma), 1e-3)
        detail = usable * (log - cv2.GaussianBlur(log * usable, (0, 0), sigma) / weight)
        return cls(np.asarray(detail, np.float32), usable)

    def resized(self, size: tuple[int, int]) -> HighPassImage:
        """The same at a smaller size (w, h)."""
        usable = cv2.resize(self.usable, size, interpolation=cv2.INTER_AREA)
        detail = cv2.resize(self.detail, size, interpolation=cv2.INTER_AREA)
        return HighPassImage(np.asarray(detail, np.float32), (usable > USABLE).astype(np.float32))


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


def scaled_size(size: tuple[int, int], width: int) -> tuple[int, int]:
    """(w, h) of an image of (W, H) that is at most `width` px wide."""
    factor = min(1.0, width / size[0])
    return max(round(size[0] * factor), 1), max(round(size[1] * factor), 1)


def choose_partners(
    world_to_camera: NDArray[np.float64],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
    distance: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> list[tuple[int, ...]]:
    """Up to four partners of each frame, two before and two after it; none where the camera moves too little.

    Args:
        world_to_camera: (T, 4, 4). matrix: (3, 3) K, px. size: (width, height), px.
        distance: (T,) of the tissue that a frame sees, in the unit of the poses.
        usable: (T,) whether a frame has a pose of its own and shows tissue.
    """
    count = len(world_to_camera)
    return [
        _partners(i, world_to_camera, matrix, size, float(distance[i]), usable) if usable[i] else ()
        for i in range(count)
    ]


def _partners(
    i: int, poses: NDArray, matrix: NDArray, size: tuple[int, int], distance: float, usable: NDArray
) -> tuple[int, ...]:
    found: list[int] = []
    for side in (range(i - 1, max(i - 1 - REACH, -1), -1), range(i + 1, min(i + 1 + REACH, len(poses)))):
        others = [j for j in side if usable[j]]
        degrees = dict(zip(others, parallax(poses, i, others, matrix, size, distance), strict=True))
        fit = [j for j in others if MIN_DEGREES <= degrees[j] <= MAX_DEGREES]
        if not fit:
            continue
        first = next((j for j in fit if degrees[j] >= WANTED_DEGREES), max(fit, key=lambda j: degrees[j]))
        found.append(first)
        if rest := [j for j in fit if j != first]:
            found.append(min(rest, key=lambda j: abs(degrees[j] - SECOND * WANTED_DEGREES)))
    return tuple(found)


def parallax(
    poses: NDArray[np.float64],
    i: int,
    others: Sequence[int],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
    distance: float,
) -> NDArray[np.float64]:
    """(len(others),) median parallax of frame i with other frames, degrees; 0 where they see too little of it.

    It is that of points spread over the image, not of its middle alone: a camera that drives ahead has none there.

    Args:
        poses: (T, 4, 4) world to camera. distance: of the tissue from frame i.
    """
    x, y = (side / 2 * np.array(PROBES) for side in size)
    pixels = np.stack([*np.meshgrid(x + matrix[0, 2], y + matrix[1, 2]), np.ones((len(x), len(y)))], -1).reshape(-1, 3)
    points = pixels @ np.linalg.inv(matrix).T * distance
    turn, shift = poses[i, :3, :3], poses[i, :3, 3]
    world = (points - shift) @ turn  # R^T (p - t)
    here = world - _center(poses[i])
    out = np.zeros(len(others))
    for k, j in enumerate(others):
        seen = world @ poses[j, :3, :3].T + poses[j, :3, 3]
        image = seen @ matrix.T
        uv = image[:, :2] / np.maximum(image[:, 2:], 1e-9)
        inside = (seen[:, 2] > 0) & ((uv >= 0) & (uv < np.array(size))).all(1)
        if inside.mean() < OVERLAP:
            continue
        there = world - _center(poses[j])
        cosine = (here * there).sum(1) / (np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1))
        out[k] = np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))[inside]))
    return out


def _center(world_to_camera: NDArray) -> NDArray:
    return -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
