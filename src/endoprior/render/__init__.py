"""Splats + Camera -> RenderOutput. Knows nothing of time, priors or losses.

Backends are named by what they are. `reference` is plain PyTorch: dense, slow, any floating type. `numba` runs on the
CPU, float32. Two need an NVIDIA GPU, float32: `triton`, kernels of our own, and `gsplat`, that library.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Protocol, get_args

from ..core.checks import input_error, or_did_you_mean
from ..core.config import Backend
from ..core.kernel_folder import without_kernel_cache

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from ..core.types import Camera, RenderOutput, Splats

ON_GPU = ("gsplat", "triton")
"""Backends that need an NVIDIA GPU."""


class Rasterizer(Protocol):
    """What `load` returns."""

    def __call__(
        self, splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True
    ) -> RenderOutput:
        """Render the Gaussians, near to far.

        Args:
            background: (3,) color behind everything, in [0, 1].
            depth_grad_to_means: False stops the gradient of `depth` from reaching the composited z values; z still gets
                gradient through the projected covariance, and the weights keep theirs.
        Raises:
            ValueError: a shape, a floating type or the number of SH coefficients does not fit.
        """
        ...


def load(backend: Backend) -> Rasterizer:
    """Import one backend. There is no fallback: the caller gets the one it named, or an error.

    Raises:
        InputError: there is no backend of that name, or the library it needs, gsplat or Triton, is not installed.
    """
    if backend not in get_args(Backend):
        names = get_args(Backend)
        fix = or_did_you_mean("choose one of them.", backend, names)
        raise input_error("backend", f"one of {', '.join(names)}", repr(backend), fix)
    try:
        return import_module(f".{backend}", __package__).rasterize
    except RuntimeError as error:
        raise without_kernel_cache(error) or error from None


def load_many(backend: Backend) -> Callable[..., list[RenderOutput]]:
    """How one backend renders several time steps: `many(splats, cameras, *, background)`, lists of equal length.

    They must agree in the number of Gaussians and the SH degree, the cameras in size.

    Raises:
        InputError: as `load`.
    """
    rasterize = load(backend)
    if backend == "gsplat":
        return import_module(".gsplat", __package__).rasterize_many

    def one_by_one(splats: list[Splats], cameras: list[Camera], *, background: Tensor) -> list[RenderOutput]:
        return [rasterize(each, camera, background=background) for each, camera in zip(splats, cameras, strict=True)]

    return one_by_one
