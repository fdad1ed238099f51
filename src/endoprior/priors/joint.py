"""The joint texture prior: high on textured tissue without highlights. `H, W` image size."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .specular import specular_likelihood

Border = Literal["reflect", "zero"]
"""How the Sobel filter continues the image: `zero` makes bright borders edges (released code)."""
PERCENTILE = 99.0
"""p: the edge magnitude at this percentile of tissue pixels maps to 1."""
EPSILON = 1e-6
"""Keeps the salience of a constant image finite; in units of gray (0..1) times the kernel's weight."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the gray image (ITU-R BT.601)."""


def salience(
    rgb: NDArray[np.floating], tissue_mask: NDArray[np.bool_], border: Border = "reflect"
) -> NDArray[np.float32]:
    """Strength of edges and texture, relative to a high percentile on tissue. E, paper Eqs. (3)-(5).

    Does not check its input; `joint_texture_prior` does.

    Args:
        rgb: (H, W, 3) color in [0, 1].
        tissue_mask: (H, W) True where the percentile is taken; the result is not masked.
    Returns:
        (H, W) salience in [0, 1]; all 0 when the mask is empty.
    """
    red, green, blue = (np.float32(w) * rgb[..., c].astype(np.float32) for c, w in enumerate(LUMA))
    magnitude = edge_magnitude(red + green + blue, border)
    on_tissue = magnitude[tissue_mask]
    if on_tissue.size == 0:
        return np.zeros_like(magnitude)
    strong = np.float32(np.percentile(on_tissue, PERCENTILE) + EPSILON)
    return np.minimum(magnitude / strong, np.float32(1))


def edge_magnitude(gray: NDArray[np.floating], border: Border = "reflect") -> NDArray[np.float32]:
    """Length of the Sobel gradient, sqrt(Gx^2 + Gy^2), with the 3 x 3 kernels of paper Eq. (4).

    Args:
        gray: (H, W) intensity.
        border: `reflect` mirrors about the border pixel, so that a constant image has no edge; `zero` pads with 0.
    Returns:
        (H, W) magnitude >= 0; a unit step gives 4.
    """
    gray = np.asarray(gray, np.float32)
    padded = np.pad(gray, 1, mode="reflect") if border == "reflect" else np.pad(gray, 1)
    # Both kernels are separable: a difference along one axis, weights 1 2 1 along the other.
    along_x = padded[:, 2:] - padded[:, :-2]
    along_y = padded[2:] - padded[:-2]
    gradient_x = along_x[:-2] + np.float32(2) * along_x[1:-1] + along_x[2:]
    gradient_y = along_y[:, :-2] + np.float32(2) * along_y[:, 1:-1] + along_y[:, 2:]
    return np.sqrt(gradient_x * gradient_x + gradient_y * gradient_y)


def joint_texture_prior(
    rgb: NDArray[np.floating],
    tissue_mask: NDArray[np.bool_],
    *,
    value_threshold: float | None = None,
    border: Border = "reflect",
) -> NDArray[np.float32]:
    """Reliability of each pixel as the position of a Gaussian: rho = M (1 - L^sp) E, paper Eq. (1).

    Args:
        rgb: (H, W, 3) floating-point color in [0, 1].
        tissue_mask: (H, W) bool, True on usable tissue (M).
        value_threshold: brightness above which a pale pixel is a highlight; None: the paper's.
        border: see `Border`.
    Returns:
        (H, W) prior in [0, 1]; 0 off the tissue, and everywhere when the mask is empty.
    Raises:
        ValueError: a shape or type differs, or a color is not finite or outside [0, 1].

    Example:
        >>> import endoprior
        >>> frame = endoprior.load_sequence("DATA")[0]
        >>> prior = endoprior.joint_texture_prior(frame.rgb, frame.tissue_mask)
        >>> prior.shape, bool((prior[~frame.tissue_mask] == 0).all())
        ((48, 64), True)
    """
    rgb, tissue_mask = np.asarray(rgb), np.asarray(tissue_mask)
    check_shape("rgb:H,W,3 tissue_mask:H,W", rgb=rgb, tissue_mask=tissue_mask)
    _check_values(rgb, tissue_mask)
    keep = np.float32(1) - specular_likelihood(rgb, value_threshold)
    return np.where(tissue_mask, keep * salience(rgb, tissue_mask, border), np.float32(0))


def _check_values(rgb: NDArray, tissue_mask: NDArray) -> None:
    """Raise ValueError unless `rgb` is an image of floats in [0, 1] and `tissue_mask` is bool."""
    if not np.issubdtype(rgb.dtype, np.floating):
        raise ValueError(f"rgb must be floating point in [0, 1], got {rgb.dtype}. Divide 8-bit color by 255.")
    if tissue_mask.dtype != np.bool_:
        raise ValueError(f"tissue_mask must be bool, True on tissue, got {tissue_mask.dtype}. Compare it with a value.")
    if rgb.size == 0:
        raise ValueError(f"rgb must have at least one pixel, got shape {rgb.shape}.")
    low, high = float(rgb.min()), float(rgb.max())
    # The negated comparison also catches NaN, which min and max propagate.
    if not (low >= 0 and high <= 1):
        raise ValueError(f"rgb must be finite and in [0, 1], got values from {low:g} to {high:g}. Scale the image.")
