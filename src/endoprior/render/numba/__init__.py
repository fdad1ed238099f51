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
from ..autograd import rasterize_with
from ..projection import check, check_device, jacobian_limits
from . import tiles
from .composite_backward import NUM_SUMS, composite_backward, gather
from .composite_forward import composite_forward
from .projection import project_backward, project_forward


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Render the Gaussians near to far. See `render.Rasterizer`.

    Raises:
        ValueError: the input is not float32 on the CPU, or its shapes disagree.
    """
    check(splats, background)
    check_device(splats, background, "cpu")
    return rasterize_with(KERNELS, splats, camera, background, depth_grad_to_means)


def _arrays(*tensors: Tensor) -> list[NDArray]:
    """The memory of contiguous tensors as NumPy arrays."""
    return [tensor.detach().numpy() for tensor in tensors]


def camera_arrays(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What the projection kernels read of a camera: see `numba.projection`."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, *jacobian_limits(camera))
    view = np.ascontiguousarray(camera.world_to_camera, np.float64)
    return view, np.ascontiguousarray(camera.center, np.float64), np.array(lens, np.float64)


class _Kernels:
    """See `autograd.Kernels`."""

    def project_forward(
        self, means: Tensor, quats: Tensor, scales: Tensor, sh: Tensor, opacities: Tensor, camera: Camera
    ) -> tuple[Tensor, ...]:
        num = len(means)
        outputs = [means.new_empty(shape) for shape in [(num, 2), (num, 3), (num,), (num, 3)]]
        outputs.append(means.new_empty(num, dtype=torch.int32))
        inputs = _arrays(means, quats, scales, opacities, sh)
        project_forward(*inputs, *camera_arrays(camera), camera.width, camera.height, *_arrays(*outputs))
        return tuple(outputs)

    def project_backward(
        self, inputs: tuple[Tensor, ...], camera: Camera, radii: Tensor, cotangents: tuple[Tensor, ...]
    ) -> tuple[Tensor, ...]:
        grads = tuple(torch.empty_like(tensor) for tensor in inputs)
        project_backward(*_arrays(*inputs), *camera_arrays(camera), *_arrays(radii, *cotangents, *grads))
        return grads

    def bin_tiles(self, *gaussians: Tensor | tuple[int, int]) -> tiles.Tiles:
        *tensors, (width, height) = gaussians
        return tiles.build(*_arrays(*tensors), width, height)

    def composite_forward(
        self, lists: tiles.Tiles, background: Tensor, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Tensor, NDArray[np.int64]]:
        width, height = size
        color = background.new_empty((height, width, 3))
        depth, transmittance = background.new_empty((height, width)), background.new_empty((height, width))
        tile_ends = np.empty(len(lists.by_cost), np.int64)
        work = (lists.records, lists.pairs, lists.tile_starts, lists.by_cost, numba.get_num_threads())
        composite_forward(*work, *_arrays(background, color, depth, transmittance), tile_ends)
        return color, depth, transmittance, tile_ends

    def composite_backward(
        self,
        lists: tiles.Tiles,
        tile_ends: NDArray[np.int64],
        conic_ldl: Tensor,
        opacities: Tensor,
        images: tuple[Tensor, ...],
        cotangents: tuple[Tensor, ...],
    ) -> tuple[Tensor, ...]:
        sums = np.empty((len(lists.pairs), NUM_SUMS), np.float32)
        work = (lists.records, lists.pairs, lists.tile_starts, tile_ends, lists.by_cost, numba.get_num_threads())
        composite_backward(*work, *_arrays(*images, *cotangents), sums)
        num = len(opacities)
        grads = tuple(opacities.new_empty(shape) for shape in [(num, 2), (num, 3), (num,), (num, 3), (num,)])
        gather(sums, lists.slot_starts, *_arrays(conic_ldl, opacities, *grads))
        return grads


KERNELS = _Kernels()
