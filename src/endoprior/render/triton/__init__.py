# pyright: reportArgumentType=false
"""The GPU backend that needs no CUDA toolkit: kernels written in Triton, float32 on one NVIDIA device.

Same image and gradients as `reference` up to float32 rounding, and bit-identical every time, gradients included: no sum
depends on which program comes first. Triton comes with torch on Linux and compiles the kernels at their first use; for
that it needs a C compiler and Python's headers, once, but no nvcc. Once per image the host waits for the device.

With TRITON_INTERPRET=1 in the environment, when this package is first imported, Triton interprets the kernels on the
CPU: slow, and how they are tested without a GPU.
"""

from __future__ import annotations

from functools import cache
from subprocess import SubprocessError

import torch
from torch import Tensor

from ...core.checks import InputError
from ...core.types import Camera, RenderOutput, Splats
from ..autograd import Kernels, Tensors, empty_gaussians2d, empty_images, rasterize_with
from ..projection import check, check_device
from ..sh import degree_of

NEXT_STEP = "It comes with PyTorch for CUDA on Linux; `endoprior doctor` tells what is missing."

try:
    import triton

    from . import tiles
    from .composite import NUM_SUMS, composite_backward, composite_forward, gather
    from .launch import launch
    from .projection import BLOCK, lens_of, project_backward, project_forward
except ImportError as error:
    raise InputError(f"backend: triton needs Triton, which cannot be imported ({error}). {NEXT_STEP}") from error

DEVICE = "cuda" if isinstance(project_forward, triton.JITFunction) else "cpu"
"""Type of device the tensors must be on: the CPU where Triton interprets."""
GATHERED, SIDE_BY_SIDE = 16, 8
"""Gaussians whose gradients one program adds up, and how many pairs of each at a time."""
WARP = {"num_warps": 1, "enable_fp_fusion": True}
WARPS = {"num_warps": 4, "enable_fp_fusion": True}
"""How kernels are compiled. Fusion is named because its default changes between versions of Triton."""


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """Render the Gaussians near to far. See `render.Rasterizer`.

    Raises:
        ValueError: the input is not float32 on one CUDA device, or its shapes disagree.
        InputError: Triton could not build its launcher.
    """
    check(splats, background)
    demand_device(splats, background)
    return rasterize_with(KERNELS, splats, camera, background, depth_grad_to_means)


def demand_device(splats: Splats, background: Tensor) -> None:
    """Raise ValueError unless everything is float32 on one CUDA device, and start Triton there."""
    check_device(splats, background, DEVICE)
    if DEVICE == "cuda":
        _start_driver()


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


def _project_forward(gaussians: Tensors, opacities: Tensor, camera: Camera) -> Tensors:
    means, quats, scales, sh, color_slopes = gaussians
    num, lens = len(means), lens_of(camera, means.device)
    outputs = (*empty_gaussians2d(means, num), means.new_empty(num, dtype=torch.int32))
    inputs = (means, quats, scales, opacities, sh, color_slopes, lens, num, camera.width, camera.height)
    options = {"DEGREE": degree_of(sh.shape[1]), "BLOCK": BLOCK, **WARPS}
    launch(project_forward, triton.cdiv(num, BLOCK), *inputs, *outputs, **options)
    return outputs


def _project_backward(gaussians: Tensors, camera: Camera, radii: Tensor, cotangents: Tensors) -> Tensors:
    num, lens = len(radii), lens_of(camera, radii.device)
    grads = tuple(torch.empty_like(tensor) for tensor in gaussians)
    options = {"DEGREE": degree_of(gaussians[3].shape[1]), "BLOCK": BLOCK, **WARPS}
    arguments = (*gaussians, lens, num, radii, *cotangents, *grads)
    launch(project_backward, triton.cdiv(num, BLOCK), *arguments, **options)
    return grads


def _composite_forward(
    lists: tiles.Tiles, background: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    color, depth, transmittance = empty_images(background, size)
    outputs = color, depth, transmittance, torch.empty_like(lists.tile_starts[:-1])
    inputs = (lists.records, lists.ranks, lists.tile_starts, background, *size, tiles.columns(size[0]))
    launch(composite_forward, len(outputs[3]), *inputs, *outputs, ROWS=tiles.ROWS_PER_LANE, **WARP)
    return outputs


def _composite_backward(
    lists: tiles.Tiles,
    tile_ends: Tensor,
    conic_ldl: Tensor,
    color_slopes2d: Tensor,
    opacities: Tensor,
    images: Tensors,
    cotangents: Tensors,
) -> Tensors:
    num, (height, width) = len(opacities), images[1].shape
    sums = opacities.new_empty((len(lists.slots), NUM_SUMS.value))
    work = (lists.records, lists.ranks, lists.slots, lists.tile_starts, tile_ends)
    arguments = (*work, width, height, tiles.columns(width), *images, *cotangents, sums)
    launch(composite_backward, len(tile_ends), *arguments, ROWS=tiles.ROWS_PER_LANE, **WARP)
    grads = (*empty_gaussians2d(opacities, num), opacities.new_empty(num))
    arguments = (sums, lists.slot_ends, lists.order, conic_ldl, color_slopes2d, opacities, num, *grads)
    launch(gather, triton.cdiv(num, GATHERED), *arguments, BLOCK=GATHERED, SIDE_BY_SIDE=SIDE_BY_SIDE, **WARP)
    return grads


KERNELS = Kernels(_project_forward, _project_backward, tiles.build, _composite_forward, _composite_backward)
