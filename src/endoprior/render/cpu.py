"""The fast backend: Numba kernels, float32, forward and hand-written backward, on any number of CPU threads.

Same picture and gradients as `reference` up to float32 rounding, and the same bits whatever the number of threads. Two
autograd functions with `means2d` between them, so that its gradient can be kept.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..core.types import Camera, RenderOutput, Splats
from . import tiles
from .composite_backward import MOMENTS, composite_backward, gather
from .composite_forward import composite_forward
from .project_kernels import project_backward, project_forward
from .projection import check, jacobian_limits


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Draw the Gaussians near to far. See `render.Rasterizer`.

    Raises:
        ValueError: the input is not float32 on the CPU, or its shapes disagree.
    """
    check(splats, background)
    if splats.means.dtype != torch.float32 or splats.means.device.type != "cpu":
        raise ValueError(f"splats must be float32 on the cpu; got {splats.means.dtype} on {splats.means.device}")
    means2d, row_forms, z, colors, radii = Project.apply(
        splats.means, splats.quats, splats.scales, splats.sh, splats.opacities.detach(), camera
    )
    color, alpha, depth = Composite.apply(
        means2d,
        row_forms,
        z if depth_grad_to_means else z.detach(),
        colors,
        splats.opacities,
        background,
        radii,
        (camera.width, camera.height),
    )
    return RenderOutput(color, alpha, depth, means2d, radii)


def _array(tensor: Tensor) -> NDArray[np.float32]:
    """The tensor's memory as C-contiguous NumPy array, copied only if it has to be."""
    return tensor.detach().contiguous().numpy()


def camera_arrays(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What the projection kernels read of a camera: see `project_kernels`."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, *jacobian_limits(camera))
    view = np.ascontiguousarray(camera.world_to_camera, np.float64)
    return view, np.ascontiguousarray(camera.center, np.float64), np.array(lens, np.float64)


class Project(torch.autograd.Function):
    """Gaussians in the world -> means2d (N, 2), row forms (N, 3), z (N,), colors (N, 3), radii (N,) int32."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, sh: Tensor, opacities: Tensor, camera: Camera
    ) -> tuple[Tensor, ...]:
        """Opacities only decide what can be seen."""
        inputs = [means, quats, scales, sh]
        num = len(means)
        means2d, row_forms, z, colors = (means.new_empty(shape) for shape in [(num, 2), (num, 3), (num,), (num, 3)])
        radii = means.new_empty((num,), dtype=torch.int32)
        outputs = [means2d, row_forms, z, colors, radii]
        arrays = [_array(t) for t in (means, quats, scales, opacities, sh)]
        project_forward(*arrays, *camera_arrays(camera), camera.width, camera.height, *(t.numpy() for t in outputs))
        ctx.save_for_backward(*inputs, radii)
        ctx.camera = camera
        ctx.mark_non_differentiable(radii)
        return means2d, row_forms, z, colors, radii

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, v_means2d: Tensor, v_row_forms: Tensor, v_z: Tensor, v_colors: Tensor, _: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Chain rule through the projection, zero rows where radii is 0."""
        *inputs, radii = ctx.saved_tensors
        grads = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs]
        cotangents = [_array(v) for v in (v_means2d, v_row_forms, v_z, v_colors)]
        project_backward(
            *(_array(t) for t in inputs),
            *camera_arrays(ctx.camera),
            radii.numpy(),
            *cotangents,
            *(v.numpy() for v in grads),
        )
        return *grads, None, None


class Composite(torch.autograd.Function):
    """Gaussians in the image -> color (H, W, 3), alpha (H, W), depth (H, W)."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        row_forms: Tensor,
        z: Tensor,
        colors: Tensor,
        opacities: Tensor,
        background: Tensor,
        radii: Tensor,
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sort into tiles and draw. `size` is (width, height), px."""
        width, height = size
        per_gaussian = [_array(t) for t in (means2d, row_forms, z, colors, opacities, radii)]
        work = tiles.build(*per_gaussian, width, height)
        color = means2d.new_empty((height, width, 3))
        depth, transmittance = means2d.new_empty((height, width)), means2d.new_empty((height, width))
        tile_ends = np.empty(len(work.by_cost), np.int64)
        composite_forward(
            work.records,
            work.pairs,
            work.tile_starts,
            work.by_cost,
            numba.get_num_threads(),
            _array(background),
            color.numpy(),
            depth.numpy(),
            transmittance.numpy(),
            tile_ends,
        )
        ctx.save_for_backward(row_forms, opacities, color, depth, transmittance)
        ctx.work, ctx.tile_ends = work, tile_ends
        return color, 1 - transmittance, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        """One gradient row per pair, then one sum per Gaussian."""
        row_forms, opacities, color, depth, transmittance = ctx.saved_tensors
        work, num = ctx.work, len(opacities)
        moments = np.empty((len(work.pairs), MOMENTS), np.float32)
        composite_backward(
            work.records,
            work.pairs,
            work.tile_starts,
            ctx.tile_ends,
            work.by_cost,
            numba.get_num_threads(),
            *(t.numpy() for t in (color, depth, transmittance)),
            *(_array(v) for v in (v_color, v_depth, v_alpha)),
            moments,
        )
        shapes = [(num, 2), (num, 3), (num,), (num, 3), (num,)]
        v_means2d, v_row_forms, v_opacities, v_colors, v_z = grads = [opacities.new_empty(shape) for shape in shapes]
        gather(moments, work.slot_starts, row_forms.numpy(), _array(opacities), *(v.numpy() for v in grads))
        v_background = (v_color * transmittance[..., None]).sum((0, 1)) if ctx.needs_input_grad[5] else None
        return v_means2d, v_row_forms, v_z, v_colors, v_opacities, v_background, None, None
