"""Checks of what `endoprior.rasterize` is given: an error is one line that names the argument and how to fix it.

Shared letters: `N` Gaussians, `C` cameras, `K` SH coefficients, `D` channels.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..core.checks import input_error
from . import sh

SHAPES = {
    "means": ("N", 3),
    "quats": ("N", 4),
    "scales": ("N", 3),
    "opacities": ("N",),
    "viewmats": ("C", 4, 4),
    "Ks": ("C", 3, 3),
}
"""Argument -> its shape; a letter is the same number everywhere."""
HINTS = {
    "means": "pass x, y, z of each Gaussian.",
    "quats": "pass w, x, y, z of each Gaussian.",
    "scales": "pass three standard deviations of each Gaussian.",
    "opacities": "pass one number of each Gaussian.",
    "viewmats": "pass one 4 x 4 matrix of each camera.",
    "Ks": "pass one 3 x 3 matrix of each camera.",
    "colors": "pass one row of each Gaussian.",
    "backgrounds": "pass one color of each camera.",
}
OF_CAMERAS = ("viewmats", "Ks")
"""Arguments of any type on any device: cameras are read on the CPU in double precision."""


def check_arguments(given: Mapping[str, Any], sh_degree: Any, size: tuple[Any, Any], backend: str | None) -> int:
    """Raise an error where arguments do not fit each other; the number of channels of a color.

    Args:
        given: those of `SHAPES`, colors, and backgrounds or None.
        size: width and height.
        backend: that was asked for; None: the one that suits the device of the means.
    Raises:
        InputError: naming the argument.
    """
    tensors = {
        name: _tensor(name, value) for name, value in given.items() if name != "backgrounds" or value is not None
    }
    for name, value in zip(("width", "height"), size, strict=True):
        _check_side(name, value)
    sizes: dict[str, int] = {}
    for name, wanted in SHAPES.items():
        _check_shape(name, tensors[name], wanted, sizes)
    num_channels = _check_colors(tensors["colors"], sh_degree, sizes)
    if "backgrounds" in tensors:
        _check_shape("backgrounds", tensors["backgrounds"], ("C", num_channels), sizes)
    _check_kinds({name: value for name, value in tensors.items() if name not in OF_CAMERAS}, backend)
    return num_channels


def _tensor(name: str, value: Any) -> Tensor:
    if isinstance(value, Tensor):
        return value
    kind = type(value).__name__
    if kind == "ndarray":
        raise input_error(name, "a torch.Tensor", "a NumPy array", f"`torch.from_numpy({name}).float()`.")
    fix = f"`torch.tensor({name})`." if isinstance(value, (list, tuple)) else HINTS[name]
    raise input_error(name, "a torch.Tensor", kind, fix)


def _check_side(name: str, value: Any) -> None:
    try:
        fits = operator.index(value) > 0
    except TypeError:
        fits = False
    if not fits:
        fix = f"`int({name})`." if isinstance(value, float) and value >= 1 else "pass the size of the image."
        raise input_error(name, "a whole number of px above 0", repr(value), fix)


def _check_shape(name: str, tensor: Tensor, letters: tuple[str | int, ...], sizes: dict[str, int]) -> None:
    """Compare a shape with the one wanted, and note the sizes of letters that were not known."""
    wanted, got = tuple(sizes.get(str(each), each) for each in letters), tuple(tensor.shape)
    fits = len(wanted) == len(got) and all(isinstance(w, str) or w == g for w, g in zip(wanted, got, strict=True))
    if not fits:
        raise _wrong_shape(name, wanted, got)
    sizes |= {letter: size for letter, size in zip(wanted, got, strict=True) if isinstance(letter, str)}


def _wrong_shape(name: str, wanted: tuple[str | int, ...], got: tuple[int, ...], fix: str = "") -> Exception:
    if not fix and got == wanted[1:] and "C" in (wanted[0], *SHAPES.get(name, ("C",))):
        fix = f"`{name}[None]` for one camera."
        if isinstance(wanted[0], int) and wanted[0] != 1:
            fix = f"`{name}.expand({', '.join(map(str, wanted))})` for the same in all cameras."
    elif not fix and got == (*wanted, 1):
        fix = f"`{name}[..., 0]`."
    return input_error(name, f"shape {_shown(wanted)}", _shown(got), fix or HINTS[name])


def _shown(shape: tuple[str | int, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


def _check_colors(colors: Tensor, sh_degree: Any, sizes: dict[str, int]) -> int:
    """The number of channels of a color."""
    shape, of_harmonics = tuple(colors.shape), sh_degree is not None
    wanted: tuple[str | int, ...] = (sizes["N"], "K", 3) if of_harmonics else (sizes["N"], "D")
    wanted = (sizes["C"], *wanted) if len(shape) > len(wanted) else wanted
    fits = len(shape) == len(wanted) and all(isinstance(w, str) or w == g for w, g in zip(wanted, shape, strict=True))
    if not fits:
        fix, known = "", {(degree + 1) ** 2: degree for degree in range(sh.MAX_DEGREE + 1)}
        if not of_harmonics and len(shape) > 2 and shape[-1] == 3 and shape[-2] in known:
            fix = f"pass sh_degree={known[shape[-2]]} for coefficients of spherical harmonics."
        elif of_harmonics and shape == (sizes["N"], 3):
            fix = "leave out sh_degree, as they are colors."
        raise _wrong_shape("colors", wanted, shape, fix)
    if not of_harmonics:
        return shape[-1]
    if shape[-2] not in ((degree + 1) ** 2 for degree in range(sh.MAX_DEGREE + 1)):
        fix = "pass all coefficients of a degree."
        raise input_error("colors", "1, 4, 9 or 16 coefficients per channel", str(shape[-2]), fix)
    highest = sh.degree_of(shape[-2])
    if not isinstance(sh_degree, int) or not 0 <= sh_degree <= highest:
        want = f"a whole number from 0 to {highest}, the degree of colors"
        raise input_error("sh_degree", want, repr(sh_degree), f"pass sh_degree={highest}, or more coefficients.")
    return 3


def _check_kinds(tensors: Mapping[str, Tensor], backend: str | None) -> None:
    """Raise InputError where types or devices differ, or are not those of the backend."""
    means = tensors["means"]
    own = backend == "reference" and means.dtype.is_floating_point
    dtype, device = means.dtype if own else torch.float32, means.device
    if backend == "numba" and device.type != "cpu":
        fix = "leave backend out, or pass `means.cpu()` and the others likewise."
        raise input_error("means", "a tensor on the CPU, where numba computes", str(device), fix)
    as_means = ", as means has" if own else ""
    for name, tensor in tensors.items():
        if tensor.dtype != dtype:
            fix = f"`{name}.to(means.dtype)`." if own else f"`{name}.float()`."
            raise input_error(name, f"{dtype}{as_means}", str(tensor.dtype), fix)
        if tensor.device != device:
            raise input_error(
                name, f"a tensor on {device}, as means", str(tensor.device), f"`{name}.to(means.device)`."
            )
