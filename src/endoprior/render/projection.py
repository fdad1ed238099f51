"""EWA projection in PyTorch (Zwicker et al. 2001): 3D Gaussians to 2D ones. The kernels compute the same.

The camera maps p = (x, y, z) to (fx x/z + cx, fy y/z + cy). Its Jacobian J is taken at the center, with x/z and y/z
limited to a little outside the image (`JACOBIAN_MARGIN`) because the linearization fails there. Then
`cov2d = J W R diag(s^2) R^T W^T J^T + BLUR_PX2 I`. Shared letter: `N` Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..core.checks import check_shape
from ..core.types import Camera, Splats
from . import sh
from .constants import ALPHA_MIN, BLUR_PX2, JACOBIAN_MARGIN, MIN_QUAT, NEAR_Z, OVERFLOW

FIELDS = ("means", "quats", "scales", "opacities", "sh")


@dataclass(frozen=True)
class Projected:
    """Gaussians in the image. Where `radii` is 0 the rows are finite but meaningless, and carry no gradient."""

    means2d: Tensor
    """(N, 2) centers, px."""
    cov2d: Tensor
    """(N, 3) covariance entries xx, xy, yy, blur included, px^2."""
    det: Tensor
    """(N,) its determinant, px^4, as `project` gives it: of a needle `xx yy - xy^2` keeps no digit."""
    z: Tensor
    """(N,) camera-space z of the centers, mm."""
    colors: Tensor
    """(N, 3) color seen from the camera, >= 0."""
    color_slopes2d: Tensor
    """(N, 2, 3) change of the color per px along x, then y."""
    radii: Tensor
    """(N,) int32 ceil(3 sigma) along the long axis, px; 0 where nothing of it can reach a pixel."""


def check(splats: Splats, background: Tensor) -> int:
    """Raise ValueError where shapes disagree, types differ, or K is not 1, 4, 9 or 16; return the SH degree."""
    sizes = check_shape(
        "means:N,3 quats:N,4 scales:N,3 opacities:N sh:N,K,3", **{n: getattr(splats, n) for n in FIELDS}
    )
    check_shape("background:3", background=background)
    check_shape(f"color_slopes:{sizes['N']},2,3", color_slopes=color_slopes(splats))
    dtypes = {tensor.dtype for tensor in splats.tensors.values()} | {background.dtype}
    if len(dtypes) > 1:
        raise ValueError(f"splats and background must share one dtype; got {sorted(map(str, dtypes))}")
    return sh.degree_of(sizes["K"])


def check_device(splats: Splats, background: Tensor, device_type: str) -> None:
    """Raise ValueError where something is not float32, or not on one device of that type."""
    devices = {tensor.device for tensor in splats.tensors.values()} | {background.device}
    if splats.means.dtype != torch.float32 or len(devices) > 1 or splats.means.device.type != device_type:
        found = sorted(map(str, devices))
        raise ValueError(
            f"splats and background must be float32 on one {device_type} device; got {splats.means.dtype} on {found}"
        )


def jacobian_limits(camera: Camera) -> tuple[float, float, float, float]:
    """Smallest and largest x/z, then y/z, at which the Jacobian is evaluated; they follow the true principal point."""
    margin_x = JACOBIAN_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = JACOBIAN_MARGIN * 0.5 * camera.height / camera.fy
    return (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )


def rotation_matrices(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations of (N, 4) quaternions (w, x, y, z) of any length but zero."""
    w, x, y, z = unit(quats).unbind(-1)
    entries = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in entries], -2)


def project(splats: Splats, camera: Camera) -> Projected:
    """Project every Gaussian, and find out which of them are visible.

    Culled are: center at or behind `NEAR_Z`; any number not finite, or a result that overflows; a quaternion shorter
    than `MIN_QUAT`; a footprint (where alpha >= `ALPHA_MIN`) that misses every pixel center's bounding box.
    """
    splats = replace(splats, color_slopes=color_slopes(splats))
    with torch.no_grad():  # decide first; a `where` after the fact would let NaN into the gradients
        usable = _usable(splats, camera)
    stand_in = _placeholder(splats, camera)
    safe = Splats(
        **{
            name: torch.where(usable.reshape(-1, *(1,) * (values.dim() - 1)), values, stand_in[name])
            for name, values in splats.tensors.items()
        }
    )
    means2d, cov2d, det, z, colors, slopes2d = _project(safe, camera)
    last_pixel = means2d.new_tensor([camera.width, camera.height]) - 0.5
    radii = radii_of(means2d, cov2d, safe.opacities, usable, last_pixel)
    return Projected(means2d, cov2d, det, z, colors, slopes2d, radii)


def _project(splats: Splats, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Centers, covariances and their determinants, z, colors and their slopes of Gaussians in front of the camera."""
    view = torch.as_tensor(camera.world_to_camera, dtype=splats.means.dtype, device=splats.means.device)
    x, y, z = (splats.means @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    left, right, top, bottom = jacobian_limits(camera)
    slope_x, slope_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
    axes = view[:3, :3] @ rotation_matrices(splats.quats) * splats.scales[:, None, :]  # columns: the axes, camera frame
    axes_x = (camera.fx / z)[:, None] * (axes[:, 0] - slope_x[:, None] * axes[:, 2])  # rows of J times the axes
    axes_y = (camera.fy / z)[:, None] * (axes[:, 1] - slope_y[:, None] * axes[:, 2])
    xx, xy, yy = (axes_x * axes_x).sum(-1), (axes_x * axes_y).sum(-1), (axes_y * axes_y).sum(-1)
    cov2d = torch.stack([xx + BLUR_PX2, xy, yy + BLUR_PX2], -1)
    # Of the blurred product B B^T + b I of a 2x3 matrix with rows r1, r2: |r1 x r2|^2 + b (|r1|^2 + |r2|^2) + b^2.
    det = torch.linalg.cross(axes_x, axes_y).square().sum(-1) + BLUR_PX2 * (xx + yy) + BLUR_PX2**2
    per_px = _local_per_px(cov2d, det, torch.stack([axes_x[:, :2], axes_y[:, :2]], 1))
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    towards = splats.means - torch.as_tensor(camera.center, dtype=splats.means.dtype, device=splats.means.device)
    return means2d, cov2d, det, z, sh.colors(splats.sh, unit(towards)), per_px @ color_slopes(splats)


def _local_per_px(cov2d: Tensor, det: Tensor, axes2d: Tensor) -> Tensor:
    """(N, 2, 2) change of the first two local coordinates, in standard deviations, per px along x, then y.

    A Gaussian at local coordinates q ~ N(0, I) projects to B q plus the blur, with B = `axes2d` for the first two axes.
    Of what is seen at offset d from its center the mean of q is B^T cov2d^-1 d: that is where on it the pixel lies.
    """
    xx, xy, yy = cov2d.unbind(-1)
    inverse = torch.stack([torch.stack([yy, -xy], -1), torch.stack([-xy, xx], -1)], 1) / det[:, None, None]
    return inverse @ axes2d


def color_slopes(splats: Splats) -> Tensor:
    """(N, 2, 3) the slopes; zeros where there are none."""
    return splats.means.new_zeros(len(splats), 2, 3) if splats.color_slopes is None else splats.color_slopes


def unit(vectors: Tensor) -> Tensor:
    """(N, C) vectors at length 1. They are brought near it first, so that no square vanishes or overflows."""
    vectors = vectors / vectors.detach().abs().amax(-1, keepdim=True)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def _usable(splats: Splats, camera: Camera) -> Tensor:
    """(N,) True where the Gaussian is finite, in front of the camera, and stays finite when projected."""
    per_gaussian = [splats.means, splats.quats, splats.scales, splats.opacities[:, None], splats.sh.flatten(1)]
    slopes = color_slopes(splats).flatten(1)
    usable = torch.cat([*per_gaussian, slopes], -1).isfinite().all(-1)
    means2d, cov2d, _, z, colors, _ = _project(splats, camera)
    sizes = [means2d, z[:, None], (cov2d[:, :1] * cov2d[:, 2:]), colors, slopes]
    largest = torch.cat(sizes, -1).abs().sum(-1)
    length = splats.quats.norm(dim=-1)
    return usable & (z > NEAR_Z) & (length >= MIN_QUAT) & (largest < OVERFLOW)  # False for NaN


def _placeholder(splats: Splats, camera: Camera) -> dict[str, Tensor]:
    """One harmless Gaussian, 1 mm small and 1 mm beyond the near plane, to stand in for the culled ones."""
    like = {"dtype": splats.means.dtype, "device": splats.means.device}
    rotation, center = torch.as_tensor(camera.world_to_camera[:3, :3], **like), torch.as_tensor(camera.center, **like)
    return {
        "means": center + (NEAR_Z + 1) * rotation[2],
        "quats": splats.quats.new_tensor([1.0, 0.0, 0.0, 0.0]),
        "scales": splats.scales.new_ones(3),
        "opacities": splats.opacities.new_tensor(0.0),
        "sh": splats.sh.new_zeros(splats.sh.shape[1:]),
        "color_slopes": splats.sh.new_zeros(2, 3),
    }


@torch.no_grad()
def radii_of(means2d: Tensor, cov2d: Tensor, opacities: Tensor, usable: Tensor, last_pixel: Tensor) -> Tensor:
    """(..., N) int32 ceil(3 sigma_max), and 0 unless the box around {alpha >= ALPHA_MIN} holds a pixel center.

    Args:
        means2d, cov2d, opacities, usable: (..., N, 2), (..., N, 3), (..., N), (..., N).
        last_pixel: center of the last pixel (x, y), px.
    """
    xx, xy, yy = cov2d.unbind(-1)
    long_axis = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
    reach = (2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))).sqrt()  # in standard deviations
    box = reach[..., None] * torch.stack([xx, yy], -1).sqrt()
    touches = ((means2d + box >= 0.5) & (means2d - box <= last_pixel)).all(-1)
    radii = (3 * long_axis.sqrt()).ceil().clamp(max=2**30).to(torch.int32)
    return torch.where(usable & touches & (opacities >= ALPHA_MIN), radii, 0)
