"""The GPU backend that needs no CUDA toolkit: kernels written in Triton, float32 on one NVIDIA device.

Same picture and gradients as `reference` up to float32 rounding, and the same bits every time, gradients included: no
sum depends on which program comes first. Triton comes with torch on Linux and compiles the kernels at their first use;
for that it wants a C compiler and Python's headers, once, but no nvcc. Two autograd functions with `means2d` between
them, so that its gradient can be kept.

Once per picture the host waits for the number of pairs (Gaussian, tile). Within `without_waiting`, and while a CUDA
graph is captured, it does not; then ask `overflowed` whether there was room for them; `QUEUED` offers both. Graphs are
captured after one picture of every camera was drawn: a camera that was not seen before is copied to the device.

With TRITON_INTERPRET=1 in the environment, when this module is first imported, Triton interprets the kernels on the
CPU: slow, and how they are tested without a GPU.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from subprocess import SubprocessError
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..core.checks import InputError
from ..core.types import Camera, RenderOutput, Splats
from . import Queued
from .projection import check, check_device
from .sh import degree_of

NEXT_STEP = "It comes with PyTorch for CUDA on Linux; `endoprior doctor` tells what is missing."

try:
    import triton

    from . import triton_bins as bins
    from .triton_bins import lacking, overflowed, without_waiting
    from .triton_composite import MOMENTS, composite_backward, composite_forward, gather
    from .triton_project import BLOCK, lens_of, project_backward, project_forward
except ImportError as error:
    raise InputError(f"backend: triton needs Triton, which cannot be imported ({error}). {NEXT_STEP}") from error

__all__ = ["QUEUED", "overflowed", "rasterize", "without_waiting"]

DEVICE = "cuda" if isinstance(project_forward, triton.JITFunction) else "cpu"
"""Type of device the tensors must be on: the CPU where Triton interprets."""
GATHERED, SIDE_BY_SIDE = 16, 8
"""Gaussians whose gradients one program adds up, and how many pairs of each at a time."""
WARP = {"num_warps": 1, "enable_fp_fusion": True}
WARPS = {"num_warps": 4, "enable_fp_fusion": True}
"""How kernels are compiled. Fusion is named because its default changes between versions of Triton."""


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Draw the Gaussians near to far. See `render.Rasterizer`.

    Raises:
        ValueError: the input is not float32 on one CUDA device, or its shapes disagree.
        InputError: Triton could not build its launcher.
    """
    check(splats, background)
    check_device(splats, background, DEVICE)
    if DEVICE == "cuda":
        _start_driver()
    with _current(splats.means.device):
        means2d, forms, z, colors, radii, keys = Project.apply(
            splats.means, splats.quats, splats.scales, splats.sh, splats.opacities.detach(), camera
        )
        color, alpha, depth = Composite.apply(
            means2d,
            forms,
            z if depth_grad_to_means else z.detach(),
            colors,
            splats.opacities,
            background,
            radii,
            keys,
            (camera.width, camera.height),
        )
    return RenderOutput(color, alpha, depth, means2d, radii)


def _rasterize_queued(
    splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True
) -> RenderOutput:
    """As `rasterize`, without waiting."""
    with without_waiting():
        return rasterize(splats, camera, background=background, depth_grad_to_means=depth_grad_to_means)


QUEUED = Queued(_rasterize_queued, incomplete=lacking, make_room=overflowed)


@cache
def _start_driver() -> None:
    """Have Triton build its launcher, a C file, or say in one line why it cannot."""
    try:
        triton.runtime.driver.active  # noqa: B018  (made when it is first asked for)
    except (RuntimeError, OSError, AssertionError, ImportError, SubprocessError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"backend: triton could not start ({reason}). It needs an NVIDIA driver and, once, a C compiler and the "
            "headers of Python; `endoprior doctor` tells what is missing."
        ) from error


def _current(device: torch.device) -> AbstractContextManager:
    """Triton launches on the current device, which need not be that of the tensors."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


class Project(torch.autograd.Function):
    """Gaussians in the world -> means2d (N, 2), column forms (N, 3), z (N,), colors (N, 3), radii (N,) int32, and keys
    (N,) to sort by: z, infinite where the Gaussian is not drawn."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, sh: Tensor, opacities: Tensor, camera: Camera
    ) -> tuple[Tensor, ...]:
        """Opacities only decide what can be seen."""
        means, quats, scales, sh = (t.contiguous() for t in (means, quats, scales, sh))
        num, lens = len(means), lens_of(camera, means.device)
        outputs = [means.new_empty(shape) for shape in [(num, 2), (num, 3), (num,), (num, 3)]]
        radii, keys = means.new_empty(num, dtype=torch.int32), means.new_empty(num)
        project_forward[(triton.cdiv(num, BLOCK),)](
            *(means, quats, scales, opacities.contiguous(), sh, lens, num, camera.width, camera.height),
            *(*outputs, radii, keys),
            DEGREE=degree_of(sh.shape[1]),
            BLOCK=BLOCK,
            **WARPS,
        )
        ctx.save_for_backward(means, quats, scales, sh, lens, radii)
        ctx.mark_non_differentiable(radii, keys)
        return *outputs, radii, keys

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, v_means2d: Tensor, v_forms: Tensor, v_z: Tensor, v_colors: Tensor, *_: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Chain rule through the projection, zero rows where radii is 0."""
        means, quats, scales, sh, lens, radii = ctx.saved_tensors
        grads = [torch.empty_like(t) for t in (means, quats, scales, sh)]
        cotangents = [v.contiguous() for v in (v_means2d, v_forms, v_z, v_colors)]
        num = len(means)
        with _current(means.device):
            project_backward[(triton.cdiv(num, BLOCK),)](
                *(means, quats, scales, sh, lens, num, radii, *cotangents, *grads),
                DEGREE=degree_of(sh.shape[1]),
                BLOCK=BLOCK,
                **WARPS,
            )
        return *grads, None, None


class Composite(torch.autograd.Function):
    """Gaussians in the image -> color (H, W, 3), alpha (H, W), depth (H, W)."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        forms: Tensor,
        z: Tensor,
        colors: Tensor,
        opacities: Tensor,
        background: Tensor,
        radii: Tensor,
        keys: Tensor,
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sort into tiles and draw. `size` is (width, height), px."""
        width, height = size
        opacities, background = opacities.contiguous(), background.contiguous()
        work = bins.build(means2d, forms, z, colors, opacities, radii, keys, width, height)
        color = means2d.new_empty((height, width, 3))
        alpha, depth, transmittance = (means2d.new_empty((height, width)) for _ in range(3))
        num_tiles = len(work.tile_starts) - 1
        tile_ends = torch.empty_like(work.tile_starts[:-1])
        composite_forward[(num_tiles,)](
            *(work.records, work.ranks, work.tile_starts, background, width, height, -(-width // bins.TILE_WIDTH)),
            *(color, alpha, depth, transmittance, tile_ends),
            ROWS=bins.ROWS_PER_LANE,
            **WARP,
        )
        ctx.save_for_backward(forms, opacities, color, depth, transmittance, tile_ends)
        ctx.work = work
        return color, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor) -> tuple[Tensor | None, ...]:
        """One row of sums per pair, then one sum per Gaussian."""
        forms, opacities, color, depth, transmittance, tile_ends = ctx.saved_tensors
        work, num, (height, width) = ctx.work, len(opacities), depth.shape
        capacity = len(work.slots)
        grads = [opacities.new_empty(shape) for shape in [(num, 2), (num, 3), (num,), (num, 3), (num,)]]
        v_means2d, v_forms, v_opacities, v_colors, v_z = grads
        moments = opacities.new_empty((capacity, MOMENTS.value))
        with _current(forms.device):
            composite_backward[(len(tile_ends),)](
                *(work.records, work.ranks, work.slots, work.tile_starts, tile_ends),
                *(width, height, -(-width // bins.TILE_WIDTH), color, depth, transmittance),
                *(v.contiguous() for v in (v_color, v_depth, v_alpha)),
                moments,
                ROWS=bins.ROWS_PER_LANE,
                **WARP,
            )
            gather[(triton.cdiv(num, GATHERED),)](
                *(moments, work.slot_ends, work.order, forms, opacities, num, capacity, *grads),
                BLOCK=GATHERED,
                SIDE_BY_SIDE=SIDE_BY_SIDE,
                **WARP,
            )
        v_background = (v_color * transmittance[..., None]).sum((0, 1)) if ctx.needs_input_grad[5] else None
        return v_means2d, v_forms, v_z, v_colors, v_opacities, v_background, None, None, None
