"""`endoprior.rasterize`: Gaussian splatting on a CPU, with the names, shapes and return values of gsplat's function.

Everything is converted at this door. Our near plane is a constant, so the scene is scaled until it lies there: an image
does not depend on the unit of length. Shared letters: `N` Gaussians, `C` cameras, `K` SH coefficients, `D` channels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ..core.checks import input_error, or_did_you_mean
from ..core.types import MIN_ALPHA, Camera, Splats
from . import load, sh
from .arguments import check_arguments
from .autograd import Composite, Project, Tensors
from .constants import BLUR_PX2, NEAR_Z
from .projection import Projected, check, project, unit
from .reference import composite

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
SteppedBackend = Literal["reference", "numba", "triton"]
CHANNELS = 3
"""Channels that are composited at a time."""
ONLY = {
    "radius_clip": 0.0, "eps2d": BLUR_PX2, "packed": False, "sparse_grad": False, "absgrad": False,
    "rasterize_mode": "classic", "distributed": False, "camera_model": "pinhole", "segmented": False, "covars": None,
    "with_ut": False, "with_eval3d": False, "radial_coeffs": None, "tangential_coeffs": None,
    "thin_prism_coeffs": None, "ftheta_coeffs": None, "viewmats_rs": None,
}  # fmt: skip
"""Option of gsplat -> the one value of it that this function has."""
FREE = ("tile_size", "channel_chunk")
"""Options of gsplat that change no result."""
NOT_RIGID = 1e-3
"""Largest entry of R R^T - I of a rotation R in float32."""


class Seen(NamedTuple):
    """Gaussians in the image of one camera, as a backend's two steps exchange them."""

    means2d: Tensor
    shape: Tensor
    """(N, ...) what the backend takes for the covariance in the image."""
    z: Tensor
    colors: Tensor
    slopes: Tensor
    """(N, 2, 3) change of the color per px: 0 here."""
    radii: Tensor


class Steps(NamedTuple):
    """The two differentiable steps of a backend, and the check of what it takes."""

    demand: Callable[[Splats, Tensor], None]
    project: Callable[..., Any]
    """Camera, opacities, means, quats, scales, sh, color slopes -> the fields of `Seen`."""
    composite: Callable[..., Any]
    """(width, height), radii, background, the other fields of `Seen`, opacities -> color, alpha, depth."""


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    backend: SteppedBackend | None = None,
    **options: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians from several cameras, like gsplat's `rasterization`, on a CPU too.

    Gradients reach means, quats, scales, opacities, colors, backgrounds and viewmats; none reaches Ks. That of viewmats
    is right for motions of the camera: parts that would leave rotations have no meaning.

    Args:
        means: (N, 3) centers in the world, any unit of length.
        quats: (N, 4) rotations (w, x, y, z) of any length but 0.
        scales: (N, 3) standard deviations along the local axes, no logarithms.
        opacities: (N,) in [0, 1].
        colors: (N, D) or (C, N, D) channels, any D; with `sh_degree`, (N, K, 3) or (C, N, K, 3) SH coefficients.
        viewmats: (C, 4, 4) world to camera: x right, y down, z forward.
        Ks: (C, 3, 3) intrinsics, px; the center of the first pixel is (0.5, 0.5).
        near_plane, far_plane: Gaussians whose center has a z outside are culled.
        sh_degree: 0 to 3, at most that of the coefficients; None: colors are colors.
        backgrounds: (C, D) color behind everything; None: 0.
        render_mode: color, depth as the sum of weight * z ("D") or divided by alpha ("ED"), or both.
        backend: None: "numba" on the CPU, "triton" on a GPU, float32 both. "reference": PyTorch, for tests, any float.
        options: those of gsplat; what is not supported is rejected.
    Returns:
        colors (C, H, W, D), (C, H, W, 1) or (C, H, W, D + 1), depth last; alphas (C, H, W, 1); and info: `means2d`
        (C, N, 2) px, whose gradient can be kept with `retain_grad()`, `radii` (C, N, 2) px, 0 where culled, `depths`
        (C, N), `opacities` (C, N), `width`, `height`, `n_cameras`, and None as `camera_ids` and `gaussian_ids`.
    Raises:
        InputError: shapes, types or devices do not fit, an option is not supported, a view is not rigid, or intrinsics
            have skew.

    Example:
        >>> import torch, endoprior
        >>> means, scales = torch.tensor([[0.0, 0.0, 4.0]], requires_grad=True), torch.full((1, 3), 0.3)
        >>> quats, opacities, colors = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([0.9]), torch.ones(1, 3)
        >>> views, Ks = torch.eye(4)[None], torch.tensor([[[50.0, 0.0, 40.0], [0.0, 50.0, 30.0], [0.0, 0.0, 1.0]]])
        >>> image, alpha, info = endoprior.rasterize(means, quats, scales, opacities, colors, views, Ks, 80, 60)
        >>> image.shape, alpha.shape
        (torch.Size([1, 60, 80, 3]), torch.Size([1, 60, 80, 1]))
        >>> image.sum().backward()
    """
    _reject(options, render_mode, near_plane, far_plane)
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    given |= {"viewmats": viewmats, "Ks": Ks, "backgrounds": backgrounds}
    num_channels = check_arguments(given, sh_degree, (width, height), backend)
    scale = NEAR_Z / near_plane
    cameras = _cameras(viewmats, Ks, width, height, scale)
    if backgrounds is None:
        backgrounds = means.new_zeros(len(cameras), num_channels)
    if sh_degree is not None:
        colors = colors[..., : (sh_degree + 1) ** 2, :]
    colors = colors.expand(len(cameras), *colors.shape[-2 if sh_degree is None else -3 :])
    steps = _steps(backend or ("numba" if means.device.type == "cpu" else "triton"))
    seen = []
    for camera, view, own_colors in zip(cameras, viewmats, colors, strict=True):
        coefficients = means.new_zeros(len(means), 1, 3) if sh_degree is None else own_colors
        splats = Splats(means, quats, scales, _not_beyond(far_plane, means, opacities, view), coefficients)
        steps.demand(splats, backgrounds)
        found = _project(steps, splats, camera, view, scale)
        seen.append(found if sh_degree is not None else found._replace(colors=own_colors))
    means2d = torch.stack([each.means2d for each in seen])  # images are made of it: its gradient can be kept
    images, alphas = [], []
    for each, centers, background in zip(seen, means2d, backgrounds, strict=True):
        color, alpha, depth = _composite(steps, each._replace(means2d=centers), opacities, background, (width, height))
        images.append(_image(color, alpha, depth, render_mode))
        alphas.append(alpha[..., None])
    info = {
        "means2d": means2d,
        "radii": torch.stack([each.radii for each in seen])[..., None].expand(-1, -1, 2),
        "depths": torch.stack([each.z for each in seen]),
        "opacities": opacities.expand(len(cameras), -1),
        "width": width,
        "height": height,
        "n_cameras": len(cameras),
        "camera_ids": None,
        "gaussian_ids": None,
    }
    return torch.stack(images), torch.stack(alphas), info


def _reject(options: dict[str, Any], render_mode: str, near_plane: float, far_plane: float) -> None:
    """Raise InputError for what this function does not have."""
    for name, value in options.items():
        if name in FREE:
            continue
        if name not in ONLY:
            names = (*ONLY, *FREE, "near_plane", "far_plane", "sh_degree", "backgrounds", "render_mode", "backend")
            fix = or_did_you_mean("leave it out.", name, names)
            raise input_error(name, "an option of `rasterize`", "none of its options", fix)
        array = "a tensor" if isinstance(value, Tensor) else "an array" if isinstance(value, np.ndarray) else ""
        if array or value != ONLY[name]:
            got = array or repr(value)
            fix = "leave it out; `gsplat.rasterization` has it, on an NVIDIA GPU."
            raise input_error(name, f"{ONLY[name]!r}, as nothing else is supported", got, fix)
    if render_mode not in get_args(RenderMode):
        fix = or_did_you_mean("choose one of them.", render_mode, get_args(RenderMode))
        raise input_error("render_mode", f"one of {', '.join(get_args(RenderMode))}", repr(render_mode), fix)
    if not 0 < near_plane < far_plane:
        got = f"{near_plane!r} and {far_plane!r}"
        raise input_error("near_plane, far_plane", "0 < near_plane < far_plane", got, "leave them out.")


def _cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int, scale: float) -> list[Camera]:
    """The cameras of a scene that was scaled."""
    cameras = []
    for k, (view, matrix) in enumerate(zip(_numbers(viewmats), _numbers(Ks), strict=True)):
        rotation = view[:3, :3]
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not (off < NOT_RIGID and np.linalg.det(rotation) > 0 and np.array_equal(view[3], (0, 0, 0, 1))):
            want, fix = "a rotation and a translation, world to camera", "divide out its scale; check its last row."
            raise input_error(f"viewmats[{k}]", want, f"{view.round(4).tolist()}", fix)
        (fx, skew, cx), (zero, fy, cy) = matrix[:2]
        if skew or zero or not (0 < fx < np.inf and 0 < fy < np.inf) or not np.array_equal(matrix[2], (0, 0, 1)):
            want, fix = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px", "rectify the images."
            raise input_error(f"Ks[{k}]", want, f"{matrix.round(4).tolist()}", fix)
        view[:3, 3] *= scale
        cameras.append(Camera(width, height, float(fx), float(fy), float(cx), float(cy), view))
    return cameras


def _numbers(tensor: Tensor) -> NDArray[np.float64]:
    return tensor.detach().cpu().double().numpy().copy()


def _steps(backend: SteppedBackend) -> Steps:
    """The steps of a backend."""
    if backend not in get_args(SteppedBackend):
        names = ", ".join(get_args(SteppedBackend))
        fix = "`gsplat.rasterization` takes the same arguments." if backend == "gsplat" else "choose one of them."
        raise input_error("backend", f"one of {names}", repr(backend), fix)
    if backend == "reference":
        return Steps(_demand_one_type, _project_reference, _composite_reference)
    load(backend)
    module = import_module(f".{backend}", __package__)
    return Steps(module.demand_device, partial(Project.apply, module.KERNELS), partial(Composite.apply, module.KERNELS))


def _demand_one_type(splats: Splats, background: Tensor) -> None:
    check(splats, background.new_zeros(3))


def _project_reference(camera: Camera, opacities: Tensor, *gaussians: Tensor) -> Tensors:
    means, quats, scales, coefficients, slopes = gaussians
    seen = project(Splats(means, quats, scales, opacities, coefficients, slopes), camera)
    shape = torch.cat([seen.cov2d, seen.det[:, None]], -1)
    return seen.means2d, shape, seen.z, seen.colors, seen.color_slopes2d, seen.radii


def _composite_reference(size: tuple[int, int], radii: Tensor, background: Tensor, *gaussians: Tensor) -> Tensors:
    means2d, shape, z, colors, slopes, opacities = gaussians
    seen = Projected(means2d, shape[:, :3], shape[:, 3], z, colors, slopes, radii)
    return composite(seen, opacities, size, background)


@torch.no_grad()
def _not_beyond(far_plane: float, means: Tensor, opacities: Tensor, view: Tensor) -> Tensor:
    """(N,) opacities, 0 beyond the far plane: what decides which Gaussians are culled."""
    z = means @ view[2, :3].to(means) + view[2, 3].to(means)
    return torch.where(z <= far_plane, opacities, 0)


def _project(steps: Steps, splats: Splats, camera: Camera, view: Tensor, scale: float) -> Seen:
    """The Gaussians in the image, with their z in the unit of the scene that was not scaled."""
    means, quats, coefficients = splats.means * scale, splats.quats, splats.sh
    moves = view.requires_grad
    if moves:  # kernels take a camera without gradients: Gaussians are brought to one that stands still
        view = view.to(means)
        means = (splats.means @ view[:3, :3].T + view[:3, 3]) * scale
        quats = quats @ _left_product(_quaternion(view[:3, :3])).T
        camera, coefficients = replace(camera, world_to_camera=np.eye(4)), means.new_zeros(len(means), 1, 3)
    slopes = means.new_zeros(len(means), 2, 3)
    found = steps.project(camera, splats.opacities, means, quats, splats.scales * scale, coefficients, slopes)
    seen = Seen(*found)
    seen = seen._replace(z=seen.z / scale)
    if not moves:
        return seen
    towards = splats.means + view[:3, 3] @ view[:3, :3]  # from the camera's center, in world axes
    towards = torch.where(seen.radii[:, None] > 0, towards, 1.0)
    return seen._replace(colors=sh.colors(splats.sh, unit(towards)))


def _quaternion(rotation: Tensor) -> Tensor:
    """(4,) quaternion (w, x, y, z) of a (3, 3) rotation, not of length 1.

    The matrix below is 4 q q^T; its row with the largest diagonal entry is a multiple of q, at least as long as q.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind() for row in rotation.unbind())
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    matrix = torch.stack([torch.stack(row) for row in rows])
    return matrix[int(matrix.detach().diagonal().argmax())]


def _left_product(quat: Tensor) -> Tensor:
    """(4, 4) matrix that maps a quaternion q to the Hamilton product `quat` q."""
    w, x, y, z = quat.unbind()
    return torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).view(4, 4)


def _composite(
    steps: Steps, seen: Seen, opacities: Tensor, background: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Color (H, W, D), alpha (H, W) and depth (H, W), a few channels at a time."""
    num_channels = len(background)
    missing = -num_channels % CHANNELS
    colors, background = (functional.pad(each, (0, missing)) for each in (seen.colors, background))
    parts = []
    for first in range(0, num_channels, CHANNELS):
        some = slice(first, first + CHANNELS)
        gaussians = seen._replace(colors=colors[:, some])[:-1]
        parts.append(steps.composite(size, seen.radii, background[some], *gaussians, opacities))
    return torch.cat([part[0] for part in parts], -1)[..., :num_channels], *parts[0][1:]


def _image(color: Tensor, alpha: Tensor, depth: Tensor, render_mode: RenderMode) -> Tensor:
    """(H, W, X) what a mode asks for."""
    if render_mode.endswith("ED"):
        depth = depth / alpha.clamp(min=MIN_ALPHA)
    if render_mode == "RGB":
        return color
    return torch.cat([color, depth[..., None]], -1) if "+" in render_mode else depth[..., None]
