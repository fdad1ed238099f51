"""Splats + Camera -> RenderOutput. Knows nothing of time, priors or losses.

`reference` is the definition: dense, slow, plain torch, any floating type. `cpu` is the fast one: Numba kernels,
float32. Two draw on an NVIDIA GPU, float32: `triton`, kernels of our own, and `cuda`, through gsplat; what that does
otherwise stands at the top of its file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, get_args

from ..core.checks import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch
    from torch import Tensor

    from ..core.types import Camera, RenderOutput, Splats

Backend = Literal["cpu", "cuda", "triton", "reference"]

ON_GPU = ("cuda", "triton")
"""Backends that draw on an NVIDIA GPU."""


class Rasterizer(Protocol):
    """What `load` returns."""

    def __call__(
        self, splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True
    ) -> RenderOutput:
        """Draw the Gaussians, near to far.

        Args:
            background: (3,) color behind everything, in [0, 1].
            depth_grad_to_means: False stops the gradient of `depth` from reaching the composited z values; z still gets
                gradient through the projected covariance, and the weights keep theirs.
        Raises:
            ValueError: a shape, a floating type or the number of SH coefficients does not fit.
        """
        ...


def load_many(backend: Backend) -> Callable[..., list[RenderOutput]]:
    """How one backend draws several moments: `many(splats, cameras, *, background)`, lists of equal length.

    The moments must agree in their number of Gaussians and the degree of color, the cameras in size.

    Raises:
        InputError: as `load`.
    """
    rasterize = load(backend)
    if backend == "cuda":
        return import_module(".cuda", __package__).rasterize_many

    def one_by_one(splats: list[Splats], cameras: list[Camera], *, background: Tensor) -> list[RenderOutput]:
        return [rasterize(each, camera, background=background) for each, camera in zip(splats, cameras, strict=True)]

    return one_by_one


class Queued(NamedTuple):
    """Drawing for which the host never waits, so that it can run ahead, and record. Room is chosen beforehand."""

    rasterize: Rasterizer
    """Draws as `load`'s does, but lacks the farthest Gaussians where there is no room for all."""
    incomplete: Callable[[torch.device], Tensor]
    """() bool on the device: whether a picture lacked some since `make_room` was asked."""
    make_room: Callable[[torch.device], bool]
    """Wait, see to it that such a picture will be whole when it is drawn again; whether there was one."""


def load_queued(backend: Backend) -> Queued | None:
    """How a backend draws without the host waiting; None if it cannot.

    Raises:
        InputError: as `load`.
    """
    if backend != "triton":
        return None
    load(backend)
    return import_module(".triton", __package__).QUEUED


def load(backend: Backend) -> Rasterizer:
    """Import one backend. There is no fallback: the caller gets the one it named, or an error.

    Raises:
        InputError: there is no backend of that name, or the library it draws with, gsplat or Triton, is not installed.
    """
    if backend not in get_args(Backend):
        names = ", ".join(get_args(Backend))
        raise InputError(f"backend: expected one of {names}; got {backend!r}. Choose one of those.")
    return import_module(f".{backend}", __package__).rasterize
