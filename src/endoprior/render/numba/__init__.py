# pyright: reportCallIssue=false
"""The CPU backend: Numba kernels, float32, forward and hand-written backward, on any number of CPU threads.

Same image and gradients as `reference` up to float32 rounding, and bit-identical for any number of threads.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...core.types import Camera, RenderOutput, Splats
from ..autograd import Kernels, Tensors, empty_gaussians2d, empty_images, rasterize_with
from ..projection import check, check_device, jacobian_limits
from . import tiles
from .composite import NUM_SUMS, composite_backward, composite_forward, gather
from .projection import project_backward, project_forward


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Render the Gaussians near to far. See `render.Rasterizer`.

    Raises:
        ValueError: the input is not float32 on the CPU, or its shapes disagree.
    """
    check(splats, background)
    demand_device(splats, background)
    return rasterize_with(KERNELS, splats, camera, background, depth_grad_to_means)


def demand_device(splats: Splats, background: Tensor) -> None:
    """Raise ValueError unless everything is float32 on the CPU."""
    check_device(splats, background, "cpu")


def camera_arrays(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What the projection kernels read of a camera: see `numba.projection`."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, *jacobian_limits(camera))
    view = np.ascontiguousarray(camera.world_to_camera, np.float64)
    return view, np.ascontiguousarray(camera.center, np.float64), np.array(lens, np.float64)


def _arrays(*tensors: Tensor) -> list[NDArray]:
    return [tensor.detach().numpy() for tensor in tensors]


def _project_forward(gaussians: Tensors, opacities: Tensor, camera: Camera) -> Tensors:
    means, quats, scales, sh, color_slopes = gaussians
    num = len(means)
    outputs = (*empty_gaussians2d(means, num), means.new_empty(num, dtype=torch.int32))
    inputs = _arrays(means, quats, scales, opacities, sh, color_slopes)
    project_forward(*inputs, *camera_arrays(camera), camera.width, camera.height, *_arrays(*outputs))
    return outputs


def _project_backward(gaussians: Tensors, camera: Camera, radii: Tensor, cotangents: Tensors) -> Tensors:
    grads = tuple(torch.empty_like(tensor) for tensor in gaussians)
    project_backward(*_arrays(*gaussians), *camera_arrays(camera), *_arrays(radii, *cotangents, *grads))
    return grads


def _bin_tiles(gaussians: Tensors, radii: Tensor, size: tuple[int, int]) -> tiles.Tiles:
    return tiles.build(*_arrays(*gaussians, radii), *size)


def _composite_forward(
    lists: tiles.Tiles, background: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, NDArray[np.int64]]:
    color, depth, transmittance = empty_images(background, size)
    tile_ends = np.empty(len(lists.by_cost), np.int64)
    work = (lists.records, lists.pairs, lists.tile_starts, lists.by_cost, numba.get_num_threads())
    composite_forward(*work, *_arrays(background, color, depth, transmittance), tile_ends)
    return color, depth, transmittance, tile_ends


def _composite_backward(
    lists: tiles.Tiles,
    tile_ends: NDArray[np.int64],
    conic_ldl: Tensor,
    color_slopes2d: Tensor,
    opacities: Tensor,
    images: Tensors,
    cotangents: Tensors,
) -> Tensors:
    sums = np.empty((len(lists.pairs), NUM_SUMS), np.float32)
    work = (lists.records, lists.pairs, lists.tile_starts, tile_ends, lists.by_cost, numba.get_num_threads())
    composite_backward(*work, *_arrays(*images, *cotangents), sums)
    num = len(opacities)
    grads = (*empty_gaussians2d(opacities, num), opacities.new_empty(num))
    gather(sums, lists.slot_starts, *_arrays(conic_ldl, color_slopes2d, opacities, *grads))
    return grads


KERNELS = Kernels(_project_forward, _project_backward, _bin_tiles, _composite_forward, _composite_backward)
