"""Does a backend work here? Renders 32 px with it and compares image and gradients with `reference`.

`python -m endoprior.render.trial BACKEND [compile]` is a process of its own, because a broken driver may crash or hang.
Its last line says what works or what failed; exit status 0 or 1.
"""

from __future__ import annotations

import glob
import os
import sys
from importlib.metadata import version
from importlib.util import find_spec
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ..core.checks import InputError
from ..core.config import Backend
from ..core.types import Camera, Splats
from . import ON_GPU, load

SIZE, NUM = 32, 60
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-3, 1e-2
"""Largest difference of a color or alpha, and, relative to its norm, of depth and of a gradient."""


def small_scene() -> tuple[Splats, Camera]:
    """Gaussians at 30-60 mm of 1 to 4 px; opacities below 0.98, where all backends mean the same."""
    rng = np.random.default_rng(0)
    camera = Camera(SIZE, SIZE, 1.2 * SIZE, 1.2 * SIZE, 0.5 * SIZE, 0.5 * SIZE, np.eye(4))
    z = rng.uniform(30, 60, NUM)
    sideways = (rng.uniform(0, SIZE, (NUM, 2)) - SIZE / 2) / camera.fx * z[:, None]
    values = (
        np.column_stack([sideways, z]),
        rng.normal(size=(NUM, 4)),
        rng.uniform(1, 4, (NUM, 3)) * (z / camera.fx)[:, None],
        rng.uniform(0.1, 0.98, NUM),
        rng.normal(size=(NUM, 4, 3)) * 0.3,
        rng.normal(size=(NUM, 2, 3)) * 0.1,
    )
    return Splats(*(torch.tensor(value, dtype=torch.float32) for value in values)), camera


def rendered(backend: Backend, device: str) -> dict[str, Tensor]:
    """Color, alpha, depth and the gradients of the small scene, on the CPU, float64."""
    scene, camera = small_scene()
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {name: value.to(device, dtype).requires_grad_() for name, value in scene.tensors.items()}
    out = load(backend)(Splats(**leaves), camera, background=torch.full((3,), 0.2, device=device, dtype=dtype))
    (out.color.square().sum() + out.alpha.sum() + 0.01 * out.depth.sum()).backward()
    found = {"color": out.color, "alpha": out.alpha, "depth": out.depth}
    found |= {f"gradient of {name}": value.grad for name, value in leaves.items() if value.grad is not None}
    return {name: value.detach().cpu().double() for name, value in found.items()}


def compare(backend: Backend, device: str) -> str:
    """The differences from `reference`, in words.

    Raises:
        ArithmeticError: one is too large.
    """
    want, got = rendered("reference", "cpu"), rendered(backend, device)
    image = max(float((got[name] - want[name]).abs().max()) for name in ("color", "alpha"))
    others = {name: float((got[name] - value).norm() / value.norm()) for name, value in want.items()}
    worst = max(others, key=lambda name: others[name])
    words = f"differs from `reference` by {image:.0e} in an image and {others[worst]:.0e} in the {worst}"
    if not (image <= IMAGE_TOLERANCE and others[worst] <= GRADIENT_TOLERANCE):  # also NaN
        raise ArithmeticError(words)
    return words


def gsplat_is_compiled() -> bool:
    """Whether gsplat has compiled code, of its wheel or of an earlier use; importing it could compile."""
    from torch.utils.cpp_extension import _get_build_directory

    spec = find_spec("gsplat")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    files = [os.path.join(folder, "csrc*") for folder in folders]
    files.append(os.path.join(_get_build_directory("gsplat_cuda", False), "gsplat_cuda.*"))
    return any(name.endswith((".so", ".pyd")) for pattern in files for name in glob.glob(pattern))


def attempt(backend: Backend, *, compiles: bool) -> str:
    """What works, in one line; raises whatever the backend does.

    Args:
        compiles: let gsplat compile itself, for minutes; without a GPU nothing is rendered then.
    """
    if compiles:
        from .gsplat import build_kernels

        build_kernels()
        if not torch.cuda.is_available():
            return "compiled; no GPU to render with"
    elif backend == "gsplat" and find_spec("gsplat") and not gsplat_is_compiled():
        raise InputError("not compiled. Run `endoprior doctor --compile` once; it takes minutes")
    if backend not in ON_GPU:
        return compare(backend, "cpu")
    load(backend)
    torch.cuda.init()  # says why there is no CUDA
    words = compare(backend, "cuda")
    return f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {backend} {version(backend)}; {words}"


def main(backend: Backend, *options: str) -> int:
    """Print the answer as the last line."""
    try:
        print(f"\n{' '.join(attempt(backend, compiles='compile' in options).split())}")
        return 0
    except Exception as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [""]
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        print(f"\n{kind}{lines[0].removeprefix('backend: ')}")
        return 1


if __name__ == "__main__":
    backend, *options = sys.argv[1:]
    sys.exit(main(cast(Backend, backend), *options))
