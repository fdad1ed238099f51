# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
"""The backend that calls gsplat (Apache-2.0, an extra), float32 on one CUDA device.

gsplat's separate steps are used and not its `rasterization`: color and z are composited in one pass, the gradient of z
can be stopped, and `means2d` is the tensor whose gradient is kept. Once per call the host waits for the device.

Where gsplat 1.5.3 differs from `reference`, read from its sources:

- One Gaussian's alpha ends at 0.999, not at ALPHA_MAX = 0.99, and a gradient passes: alpha differs by up to 0.009 in
  the core of a Gaussian of opacity above 0.99; of two trained scenes, at most 5 of 327,680 pixels by more than 1e-3.
- A pixel stops where its transmittance would become <= STOP_TRANSMITTANCE, here where it would become less.
- It computes with fast math: where an edge, an order or a stop depends on the last bits, one Gaussian more or less
  counts at a pixel.
- The determinant of a footprint is xx yy - xy^2, which cancels: a needle 300 px long is off by a few percent, and one
  whose determinant comes out <= 0 is culled.
- It keeps z == near_plane and NaN. So the plane given is the number next to NEAR_Z, and what `reference` culls is moved
  behind the camera before gsplat sees it, together with what might overflow there.
- `radii` is computed here, as gsplat's counts Gaussians that touch no pixel center.
- Gradients are summed with atomics: images are bit-identical for equal input, gradients are not. The backward pass
  starts from 1 - alpha, of which a full pixel keeps 3 digits: up to 0.1 % there.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.checks import InputError
from ..core.shell import install_command
from ..core.types import Camera, RenderOutput, Splats
from .constants import BLUR_PX2, MIN_QUAT, NEAR_Z, OVERFLOW
from .projection import FIELDS, check, check_device, color_slopes, jacobian_limits, project, radii_of

NEXT_STEP = f"Run `{install_command('cuda')}`; `endoprior doctor` tells what is missing."

try:
    import gsplat
except ImportError as error:
    raise InputError(f"backend: gsplat cannot be imported ({error}). {NEXT_STEP}") from error

DEVICE = "cuda"
"""Type of device the tensors must be on."""
TILE = 16
"""Side of gsplat's tiles, px."""
NEAR_PLANE = float(np.nextafter(np.float32(NEAR_Z), np.float32(1)))
"""gsplat culls z < this."""
MAX_MAGNITUDE = 1e18
"""A mean, quaternion, scale or opacity beyond it is culled: its square would leave float32."""
MAX_SH = OVERFLOW / 64
"""An SH coefficient beyond it is culled: the sum of 16 of them could leave float32."""
MAX_SIGMA = 1e9
"""px. The determinant of a wider footprint would leave float32."""
KEPT_CAMERAS = 1024
"""Cameras whose numbers stay on the device."""


class CameraTensors(NamedTuple):
    """The numbers of one camera of each of `B` time steps on the device, float32."""

    viewmats: Tensor
    """(B, 1, 4, 4) world to camera."""
    Ks: Tensor
    """(B, 1, 3, 3) intrinsics, px."""
    center: Tensor
    behind: Tensor
    """(B, 1, 3) position in the world, mm, and a point behind it: what lies there is culled."""
    last_pixel: Tensor
    """(B, 1, 2) center of the last pixel, px."""
    widest: Tensor
    """(B, 1) of a Gaussian, standard deviation / z at which its footprint could be MAX_SIGMA wide."""

    def depths(self, points: Tensor) -> Tensor:
        """(B, N) camera-space z of (B, N, 3) points, mm."""
        return (points * self.viewmats[:, :, 2, :3]).sum(-1) + self.viewmats[:, :, 2, 3]


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Render the Gaussians near to far. See `render.Rasterizer`.

    Raises:
        ValueError: the input is not float32 on one CUDA device, or its shapes disagree.
        InputError: gsplat could not build its kernels.
    """
    (out,) = rasterize_many([splats], [camera], background=background, depth_grad_to_means=depth_grad_to_means)
    return out


def rasterize_many(
    splats: list[Splats], cameras: list[Camera], *, background: Tensor, depth_grad_to_means: bool = True
) -> list[RenderOutput]:
    """Render several time steps in one call, for which the host waits once. See `render.load_many`.

    Without gradients: gsplat 1.5.3 mixes up those of several time steps of fewer than 32 Gaussians.

    Raises:
        ValueError: as `rasterize`, or the time steps differ in their number of Gaussians, or cameras in size.
    """
    degrees = {check(each, background) for each in splats}
    alike = degrees, {len(each) for each in splats}, {(camera.width, camera.height) for camera in cameras}
    if any(len(found) != 1 for found in alike) or len(splats) != len(cameras):
        raise ValueError("time steps of one call must agree in number of Gaussians, SH degree and image size")
    for each in splats:
        check_device(each, background, DEVICE)
    if not len(splats[0]):
        return [_nothing(*each, background) for each in zip(splats, cameras, strict=True)]
    build_kernels()
    return _render(splats, cameras, background, degrees.pop(), depth_grad_to_means)


def _render(
    splats: list[Splats], cameras: list[Camera], background: Tensor, degree: int, depth_grad_to_means: bool
) -> list[RenderOutput]:
    """`B` time steps of `N` Gaussians, seen by one camera each."""
    steps, width, height = len(splats), cameras[0].width, cameras[0].height
    all_means, quats, scales, opacities, coefficients = (torch.stack([getattr(s, n) for s in splats]) for n in FIELDS)
    slopes = torch.stack([color_slopes(each) for each in splats])
    together = Splats(all_means, quats, scales, opacities, coefficients, slopes)
    tensors = _together([camera_tensors(camera, background.device) for camera in cameras])
    means = torch.where(_usable(together, tensors)[..., None], all_means, tensors.behind)
    limits = {"eps2d": BLUR_PX2, "near_plane": NEAR_PLANE, "far_plane": OVERFLOW, "opacities": opacities.detach()}
    seen = tensors.viewmats, tensors.Ks, width, height
    found = gsplat.fully_fused_projection(means, None, quats, scales, *seen, **limits)
    boxes, centers, depths, conics = (each.squeeze(1) for each in found[:4])  # of the one camera of each time step
    kept = (boxes > 0).all(-1)  # rows of the others were never written
    # Each image gets a tensor of its own, whose gradient can be kept.
    means2d = [torch.where(k[:, None], c, 0) for k, c in zip(kept, centers, strict=True)]
    centers = torch.stack(means2d)
    sh = gsplat.spherical_harmonics(degree, means - tensors.center, coefficients, masks=kept)
    z = depths if depth_grad_to_means else depths.detach()
    channels = torch.cat([(sh + 0.5).clamp(min=0), z[..., None]], -1)
    sloped = splats[0].color_slopes is not None
    if sloped:
        channels = _sloped(channels, centers, splats, cameras)
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    _, pairs, pair_ids = gsplat.isect_tiles(centers, boxes, depths, TILE, tiles_x, tiles_y)
    offsets = gsplat.isect_offset_encode(pairs, steps, tiles_x, tiles_y)
    painted = centers, conics, channels, opacities, width, height, TILE, offsets, pair_ids
    blended, alpha = gsplat.rasterize_to_pixels(*painted)
    if sloped:
        blended = _at_pixels(blended)
    color, depth = blended.split([3, 1], -1)
    color = color + (1 - alpha) * background  # given to gsplat, its backward pass reads it at every Gaussian of a pixel
    a, b, c = torch.where(kept[..., None], conics.detach(), 1).unbind(-1)
    det = (a * c - b * b).clamp(min=torch.finfo(a.dtype).tiny)
    radii = radii_of(centers, torch.stack([c, -b, a], -1) / det[..., None], opacities, kept, tensors.last_pixel)
    return [RenderOutput(*image) for image in zip(color, alpha[..., 0], depth[..., 0], means2d, radii, strict=True)]


def _sloped(channels: Tensor, centers: Tensor, splats: list[Splats], cameras: list[Camera]) -> Tensor:
    """(B, N, 10) channels of colors that change within a Gaussian: gsplat blends what is constant in each.

    Slopes s and a color c at center m: sum w (c + s . (p - m)) = sum w (c - s . m) + p . sum w s at pixel p.
    """
    slopes = torch.stack([project(each, camera).color_slopes2d for each, camera in zip(splats, cameras, strict=True)])
    color, z = channels.split([3, 1], -1)
    return torch.cat([color - (centers[..., None] * slopes).sum(-2), z, slopes.flatten(-2)], -1)


def _at_pixels(blended: Tensor) -> Tensor:
    """(B, H, W, 4) color and depth from the blended channels of `_sloped`."""
    color, z, along_x, along_y = blended.split([3, 1, 3, 3], -1)
    y, x = (torch.arange(length, device=blended.device) + 0.5 for length in blended.shape[1:3])
    return torch.cat([color + x[:, None] * along_x + y[:, None, None] * along_y, z], -1)


def camera_tensors(camera: Camera, device: torch.device) -> CameraTensors:
    """The camera's numbers on that device. Those of cameras seen before are there already: no copy, no waiting."""
    view, (fx, fy, cx, cy) = np.asarray(camera.world_to_camera), (camera.fx, camera.fy, camera.cx, camera.cy)
    slope_x, slope_y = (max(-low, high) for low, high in np.array(jacobian_limits(camera)).reshape(2, 2))
    steepest = max(fx * np.hypot(1, slope_x), fy * np.hypot(1, slope_y))
    away = 1 + 1e-3 * np.linalg.norm(camera.center)  # mm; more than float32 rounds off
    intrinsics = (fx, 0, cx, 0, fy, cy, 0, 0, 1)
    ends = (camera.width - 0.5, camera.height - 0.5, MAX_SIGMA / steepest)
    numbers = np.concatenate([view.ravel(), intrinsics, camera.center, camera.center - away * view[2, :3], ends])
    return _on_device(numbers.astype(np.float32).tobytes(), device)


@lru_cache(maxsize=KEPT_CAMERAS)
def _on_device(numbers: bytes, device: torch.device) -> CameraTensors:
    # By value: an array that is changed in place, or an address that is used again, finds no stale numbers.
    parts = torch.from_numpy(np.frombuffer(numbers, np.float32).copy()).to(device).split([16, 9, 3, 3, 2, 1])
    shapes = (1, 1, 4, 4), (1, 1, 3, 3), (1, 1, 3), (1, 1, 3), (1, 1, 2), (1, 1)
    return CameraTensors(*(part.view(shape) for part, shape in zip(parts, shapes, strict=True)))


def _together(steps: list[CameraTensors]) -> CameraTensors:
    """The cameras of several time steps as one."""
    return steps[0] if len(steps) == 1 else CameraTensors(*map(torch.cat, zip(*steps, strict=True)))


@cache
def build_kernels() -> None:
    """Have gsplat build its kernels, which takes minutes the first time, or say in one line why it cannot."""
    try:
        from gsplat.cuda._backend import _C as kernels
    except (ImportError, IndexError, OSError, RuntimeError) as error:  # IndexError: no GPU to compile for
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"backend: gsplat cannot build its CUDA kernels ({reason}). {NEXT_STEP}") from error
    if kernels is None:
        raise InputError(f"backend: gsplat found no CUDA toolkit to build its kernels with. {NEXT_STEP}")


def _nothing(splats: Splats, camera: Camera, background: Tensor) -> RenderOutput:
    """The image without Gaussians, by whose number gsplat divides; tied to its inputs as any other is."""
    means2d = splats.means[:, :2]
    zero = means2d.sum() + sum(getattr(splats, name).sum() for name in FIELDS) + color_slopes(splats).sum()
    color = background.expand(camera.height, camera.width, 3) + zero
    empty = zero.expand(camera.height, camera.width)
    radii = torch.empty(0, dtype=torch.int32, device=background.device)
    return RenderOutput(color, empty.clone(), empty.clone(), means2d, radii)


@torch.no_grad()
def _usable(splats: Splats, tensors: CameraTensors) -> Tensor:
    """(B, N) False where a number is not finite or could become so; written with `<`, which is False for NaN."""
    numbers = torch.cat([splats.means, splats.quats, splats.scales, splats.opacities[..., None]], -1)
    slopes = color_slopes(splats)
    return (
        (numbers.abs() < MAX_MAGNITUDE).all(-1)
        & (splats.sh.abs() < MAX_SH).flatten(2).all(-1)
        & (slopes.abs() < MAX_SH).flatten(2).all(-1)
        & (splats.quats.norm(dim=-1) >= MIN_QUAT)
        & (splats.scales.amax(-1) < tensors.widest * tensors.depths(splats.means))
    )
