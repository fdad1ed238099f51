"""Data types shared by all packages: frozen dataclasses with almost no logic.

Shared letters: `H, W` image size, `N` Gaussians, `T` frames. Conventions (axes, pixel centers, units) are decided in
`docs/conventions.md`: OpenCV camera axes, millimeters, pixel (0, 0) centered at (0.5, 0.5), quaternions (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor


MIN_ALPHA = 1e-10  # expected depth is divided by at least this
SURE_DEPTH = 0.4  # confidence of a depth that counts as measured, see `Frame.depth_confidence`


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward).

    `dataclasses.replace(camera, world_to_camera=move @ camera.world_to_camera)` is a moved one. `move` moves the world
    in camera axes: a translation of (-5, 0, 0) mm puts the camera 5 mm to the right.
    """

    width: int
    """Image width, px."""
    height: int
    """Image height, px."""
    fx: float
    """Focal length along x, px."""
    fy: float
    """Focal length along y, px."""
    cx: float
    """Principal point x, px; the center of the left-most pixel is 0.5."""
    cy: float
    """Principal point y, px; the center of the top-most pixel is 0.5."""
    world_to_camera: NDArray[np.float64]
    """(4, 4) rigid transform from world to camera axes, translation in mm."""

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) position of the camera in world axes, mm."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation


@dataclass(frozen=True)
class Frame:
    """One frame of a sequence: the image of the left camera, its tissue mask and its depth."""

    index: int
    """Position in the sequence, 0-based, over all splits."""
    time: float
    """index / T, in [0, 1)."""
    camera: Camera
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3) color, 0..255, as stored in the file."""
    tissue_mask: NDArray[np.bool_]
    """(H, W) True on usable tissue (no tool)."""
    depth: NDArray[np.float32]
    """(H, W) z of the surface, mm; 0 where `depth_valid` is False."""
    depth_valid: NDArray[np.bool_]
    """(H, W) True where depth was measured."""
    weight: NDArray[np.float32] | None = None
    """(H, W) in [0, 1]: how far a pixel is to be believed, as M of Eq. (1) where it is tissue; None: 1 everywhere."""
    depth_confidence: NDArray[np.float32] | None = None
    """(H, W) in [0, 1]: how surely the depth was measured, 0 where it is a guess; None: 1 everywhere, or not known."""

    @property
    def rgb(self) -> NDArray[np.float32]:
        """(H, W, 3) color in [0, 1]."""
        return self.rgb_u8.astype(np.float32) / np.float32(255)


def frame_times(count: int) -> list[float]:
    """`Frame.time` of each of `count` frames."""
    return [index / count for index in range(count)]


def to_uint8(color: NDArray) -> NDArray[np.uint8]:
    """Values as an 8-bit file stores them: clipped to [0, 1], times 255, halves rounded up."""
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class Fingerprints:
    """What tells a sequence from others: SHA-256, in hex, of the names and contents of its files."""

    data: str
    """Of all files: images, masks, depth, poses and descriptions."""
    images: str
    """Of the image of each frame alone, which other masks, depth or poses do not change; empty without such files."""


@dataclass(frozen=True)
class Splats:
    """Gaussians at one time, ready to render: all values are activated."""

    means: Tensor
    """(N, 3) centers, world axes, mm."""
    quats: Tensor
    """(N, 4) rotations (w, x, y, z) of length at least 1e-12. The renderer normalizes them and culls shorter ones."""
    scales: Tensor
    """(N, 3) standard deviations along the local axes, mm, > 0."""
    opacities: Tensor
    """(N,) in (0, 1)."""
    sh: Tensor
    """(N, (D+1)**2, 3) spherical-harmonic color coefficients of degree D in 0..3."""
    color_slopes: Tensor | None = None
    """(N, 2, 3) change of the color per standard deviation along the first and the second local axis; None: one color
    each."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The tensors that are there, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class RenderedView:
    """A scene as one camera sees it at one time."""

    unclamped_color: Tensor
    """(H, W, 3) composited color; a little above 1 where bright Gaussians overlap."""
    depth: Tensor
    """(H, W) sum of weight * z, mm: too near where alpha is below 1; see `expected_depth`."""
    alpha: Tensor
    """(H, W) accumulated opacity in [0, 1)."""

    @property
    def expected_depth(self) -> Tensor:
        """(H, W) mean z of what is seen, mm: `depth` divided by alpha; 0 where alpha is 0."""
        return self.depth / self.alpha.clamp(min=MIN_ALPHA)

    @property
    def color(self) -> Tensor:
        """(H, W, 3) color in [0, 1], to show or save as an image."""
        return self.unclamped_color.clamp(0, 1)


@dataclass(frozen=True)
class RenderOutput:
    """Output of every backend. Density control reads `means2d.grad` (px) after `means2d.retain_grad()`."""

    color: Tensor
    """(H, W, 3) composited color, background included; not clamped."""
    alpha: Tensor
    """(H, W) accumulated opacity in [0, 1)."""
    depth: Tensor
    """(H, W) sum of weight * z, mm; divide by alpha for the expected depth."""
    means2d: Tensor
    """(N, 2) projected centers, px; pixel (0, 0) is centered at (0.5, 0.5)."""
    radii: Tensor
    """(N,) int32 radius of the rendered footprint, px; 0 where culled."""

    @property
    def view(self) -> RenderedView:
        """What users of a scene get of it."""
        return RenderedView(self.color, self.depth, self.alpha)
