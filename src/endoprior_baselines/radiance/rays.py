"""Rays through the centers of pixels, and the perspective space in which EndoNeRF's network sees points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from endoprior.core.types import Camera

NEAREST = 1e-6
"""Points nearer to the plane of the camera than this, in units of `scale`, are moved away from it."""


@dataclass(frozen=True)
class Rays:
    """`N` rays of one camera. The point at depth z is `origin + z * direction`."""

    origins: Tensor
    """(N, 3) world axes, mm."""
    directions: Tensor
    """(N, 3) world axes; 1 long along the camera's z axis, so that depth is z and not the length of the ray."""

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, start: int, stop: int) -> Rays:
        """Some successive rays."""
        return Rays(self.origins[start:stop], self.directions[start:stop])

    def at(self, z: Tensor) -> Tensor:
        """(N, S, 3) points at depths (N, S), mm."""
        return self.origins[:, None] + z[..., None] * self.directions[:, None]

    @property
    def units(self) -> Tensor:
        """(N, 3) directions of length 1."""
        return self.directions / self.lengths[:, None]

    @property
    def lengths(self) -> Tensor:
        """(N,) mm along the ray per mm of depth."""
        return self.directions.norm(dim=1)


def rays_of(camera: Camera, pixels: NDArray[np.integer], device: torch.device | str = "cpu") -> Rays:
    """The rays through the centers of some pixels.

    Args:
        pixels: (N,) row * width + column; the center of pixel (0, 0) is at (0.5, 0.5).
    """
    rows, columns = np.divmod(np.asarray(pixels), camera.width)
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    directions = np.stack([x, y, np.ones_like(x)], -1) @ camera.world_to_camera[:3, :3]
    origins = np.broadcast_to(camera.center, directions.shape)
    return Rays(*(torch.from_numpy(np.float32(array)).to(device) for array in (origins, directions)))


def all_rays(camera: Camera, device: torch.device | str = "cpu") -> Rays:
    """The rays of all pixels, row by row."""
    return rays_of(camera, np.arange(camera.width * camera.height), device)


def to_perspective(points: Tensor, slopes: Tensor, scale: Tensor | float) -> Tensor:
    """Points of a camera's axes in its perspective space: x and y are image coordinates, [-1, 1] in view; z is depth.

    The normalized device coordinates of NeRF have z -1 on a near plane n and 1 at infinity: 1 - 2 n / z. EndoNeRF
    compares its ray parameter there, 0 to 1, with depth over a constant, so what it learns is linear in depth. So is
    this space: 2 t - 1 for that parameter t, which is z / (2 scale). For rays of a static camera the two agree; other
    cameras then see the tissue where it is.

    Args:
        points: (..., 3) OpenCV axes of the camera, mm.
        slopes: (2,) 2 f / size of the image along x and y.
        scale: mm; depth of z = 0.
    """
    z = points[..., 2:]
    nearest = NEAREST * scale
    away = torch.where(z.abs() < nearest, nearest, z)
    return torch.cat([slopes * points[..., :2] / away, z / scale - 1], -1)


def from_perspective(points: Tensor, slopes: Tensor, scale: Tensor | float) -> Tensor:
    """The inverse of `to_perspective` for points before the camera."""
    z = (points[..., 2:] + 1) * scale
    return torch.cat([points[..., :2] / slopes * z, z], -1)
