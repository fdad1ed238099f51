"""Rays through the centers of pixels, which of them are drawn, where they are sampled and what they show.

A pixel is drawn with probability ~ M (1 + p): M is 1 where it may be drawn, and p is how often tools hide it, over the
Euclidean norm of that count over all pixels (EndoNeRF's tool-guided sampling). Tissue that is seldom seen counts more.
Samples are in ascending order; their alpha is NeRF's or NeuS's. Random numbers are passed in, never made here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from endoprior import Camera, FrameSequence
from endoprior.core.checks import input_error
from endoprior.core.geometry import FARTHEST_MM
from endoprior.core.types import Frame

MAX_DEPTHS = 2**22
"""Depths over which percentiles are taken, about: evenly spaced pixels of all frames."""
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
    """The rays through the centers of `pixels` (N,), row * width + column; that of (0, 0) is at (0.5, 0.5)."""
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


class RayFrames:
    """The training frames of a sequence by position, 0 to len - 1."""

    def __init__(self, sequence: FrameSequence, *, only_measured: bool) -> None:
        self.sequence, self.only_measured = sequence, only_measured
        self.indices = sequence.indices("train")

    def __len__(self) -> int:
        return len(self.indices)

    def frame(self, position: int) -> Frame:
        """Training frame number `position`."""
        return self.sequence.frame(self.indices[position])

    @property
    def camera(self) -> Camera:
        """Camera of the first training frame: the one that a field may refer to."""
        return self.sequence.camera(self.indices[0])

    @cached_property
    def boost(self) -> NDArray[np.float32]:
        """(H * W,) p of each pixel."""
        hidden = np.zeros((self.camera.height, self.camera.width), np.float32)
        for k in range(len(self)):
            hidden += ~self.frame(k).tissue_mask
        norm = float(np.linalg.norm(hidden))
        return (hidden / norm if norm else hidden).ravel()

    @cached_property
    def usable(self) -> list[int]:
        """Positions of frames from which a pixel can be drawn.

        Raises:
            InputError: there is none.
        """
        found = [k for k in range(len(self)) if self._drawable(k).any()]
        if not found:
            what = "tissue with depth" if self.only_measured else "tissue"
            fix = "the mask's polarity may be inverted: masks are 255 on tools."
            raise input_error(self.sequence.path, f"{what} in a training frame", "none", fix)
        return found

    def _drawable(self, position: int) -> NDArray[np.bool_]:
        frame = self.frame(position)
        return measured(frame) if self.only_measured else frame.tissue_mask

    def draw(self, position: int, num: int, rng: np.random.Generator) -> NDArray[np.intp]:
        """`num` pixels of a usable frame, row * width + column, with replacement."""
        until = np.cumsum(self._drawable(position).ravel() * (1 + self.boost), dtype=np.float64)
        found = np.searchsorted(until, rng.random(num) * until[-1], side="right")
        return np.minimum(found, np.searchsorted(until, until[-1]))  # rounding must not lead behind the last one

    def depth(self, position: int) -> NDArray[np.float32]:
        """(H, W) z of the surface, mm; 0 where tissue has no depth."""
        frame = self.frame(position)
        return np.where(measured(frame), frame.depth, np.float32(0))

    def depth_percentiles(self, low: float, high: float, *, missing: bool) -> tuple[float, float]:
        """Percentiles of the depths of all training frames, mm; 0 without any. `missing` depth counts as 0, or not."""
        every = max(1, len(self) * self.camera.width * self.camera.height // MAX_DEPTHS)
        depths = np.concatenate([self.depth(k).ravel()[::every] for k in range(len(self))])
        depths = depths if missing else depths[depths > 0]
        first, last = np.percentile(depths, (low, high)) if depths.size else (0.0, 0.0)
        return float(first), float(last)


def measured(frame: Frame) -> NDArray[np.bool_]:
    """(H, W) where tissue has a usable depth."""
    return frame.tissue_mask & frame.depth_valid & (frame.depth > 0) & (frame.depth < FARTHEST_MM)  # NaN fails too


LAST = 1e10
"""Length of the interval behind the last sample: whatever is dense there is opaque."""
FLOOR = 1e-5
"""Added to every weight, so that a ray without weights is sampled evenly."""


def jittered(values: Tensor, shares: Tensor | None) -> Tensor:
    """Ascending samples (N, S) moved by `shares` (N, S) in [0, 1) of half the gaps to their neighbors; None: not."""
    if shares is None:
        return values
    middles = (values[:, 1:] + values[:, :-1]) / 2
    low = torch.cat([values[:, :1], middles], -1)
    high = torch.cat([middles, values[:, -1:]], -1)
    return low + (high - low) * shares


def even(near: Tensor, far: Tensor, num: int) -> Tensor:
    """(N, num) samples from near (N,) to far (N,), both included."""
    steps = torch.linspace(0, 1, num, device=near.device)
    return near[:, None] * (1 - steps) + far[:, None] * steps


def by_weight(edges: Tensor, weights: Tensor, places: Tensor) -> Tensor:
    """(N, K) samples distributed like the weights (N, S) of intervals with ascending ends `edges` (N, S + 1).

    The cumulative distribution is inverted at `places` (N, K) in [0, 1]; samples ascend where these do.
    """
    shares = weights + FLOOR
    shares = shares / shares.sum(-1, keepdim=True)
    until = torch.cat([torch.zeros_like(shares[:, :1]), shares.cumsum(-1)], -1)
    right = torch.searchsorted(until, places.contiguous(), right=True).clamp(1, weights.shape[-1])
    low, high = until.gather(-1, right - 1), until.gather(-1, right)
    start, stop = edges.gather(-1, right - 1), edges.gather(-1, right)
    within = ((places - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return start + within * (stop - start)


def centers(num: int, rays: int, device: torch.device) -> Tensor:
    """(rays, num) evenly spaced places in (0, 1), for `by_weight` without chance."""
    return ((torch.arange(num, device=device) + 0.5) / num).expand(rays, num)


def sphere_ends(origins: Tensor, units: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (N,) along rays of unit directions at which they enter and leave the unit sphere.

    A ray that misses the sphere gets its nearest point twice; a ray from within starts at 0.
    """
    middle = -(origins * units).sum(-1)
    nearest = origins + middle[:, None] * units
    half = (1 - nearest.square().sum(-1)).clamp(min=0).sqrt()
    return (middle - half).clamp(min=0), (middle + half).clamp(min=0)


def surface_places(s: Tensor, distance: Tensor, inside: Tensor, sharpness: float) -> Tensor:
    """Weights (N, S - 1) of the intervals between samples by what NeuS would render at this sharpness.

    The slope of the distance in an interval is the smaller of its own and that of the interval before: it stays
    right where the surface turns away within one interval.

    Args:
        s: (N, S) ascending distances along the ray. distance: signed distance there. inside: lies in the unit sphere.
    """
    step = s[:, 1:] - s[:, :-1]
    slope = (distance[:, 1:] - distance[:, :-1]) / (step + 1e-5)
    before = torch.cat([torch.zeros_like(slope[:, :1]), slope[:, :-1]], -1)
    slope = torch.minimum(slope, before).clamp(-1e3, 0) * (inside[:, 1:] | inside[:, :-1])
    middle = (distance[:, 1:] + distance[:, :-1]) / 2
    enter = torch.sigmoid((middle - slope * step / 2) * sharpness)
    leave = torch.sigmoid((middle + slope * step / 2) * sharpness)
    return weights_of((enter - leave + 1e-5) / (enter + 1e-5))


def weights_of(alpha: Tensor) -> Tensor:
    """(N, S) share of each sample in its ray: its alpha times what the samples before it let through."""
    through = torch.cumprod(1 - alpha + 1e-7, -1)
    return alpha * torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], -1)


@dataclass(frozen=True)
class Composited:
    """What `N` rays show."""

    color: Tensor
    """(N, 3)."""
    depth: Tensor
    """(N,) sum of weight times depth, in the depth's unit; not divided by alpha."""
    alpha: Tensor
    """(N,) sum of weights."""
    weights: Tensor
    """(N, S)."""


def composited(alpha: Tensor, color: Tensor, depth: Tensor) -> Composited:
    """Blend samples of alpha (N, S) in [0, 1], color (N, S, 3) and depth (N, S) front to back over black."""
    weights = weights_of(alpha)
    return Composited((weights[..., None] * color).sum(1), (weights * depth).sum(1), weights.sum(1), weights)


def density_alpha(density: Tensor, depth: Tensor) -> Tensor:
    """1 - exp(-density x interval): NeRF's alpha, of density (N, S) before the ReLU at ascending depth (N, S)."""
    last = torch.full_like(depth[:, :1], LAST)
    return 1 - torch.exp(-torch.relu(density) * torch.cat([depth[:, 1:] - depth[:, :-1], last], -1))


def surface_alpha(distance: Tensor, slope: Tensor, step: Tensor, sharpness: Tensor, anneal: float) -> Tensor:
    """NeuS's alpha: how much of the logistic distribution around the surface a step takes in.

    With the slope c of the distance along the ray, the distance is d - c step / 2 where the step begins and d + c step
    / 2 where it ends; alpha = (S(begin) - S(end)) / S(begin), with S the sigmoid of sharpness times distance. At first
    a surface that faces away counts half, so that gradients reach it: `anneal` goes from 0 to 1.

    Args:
        distance: (N, S) in the middle of each `step`. slope: its change along the ray, -1 where that meets it head on.
    """
    facing = -(torch.relu(0.5 - 0.5 * slope) * (1 - anneal) + torch.relu(-slope) * anneal)
    enter = torch.sigmoid((distance - facing * step / 2) * sharpness)
    leave = torch.sigmoid((distance + facing * step / 2) * sharpness)
    return ((enter - leave + 1e-5) / (enter + 1e-5)).clamp(0, 1)
