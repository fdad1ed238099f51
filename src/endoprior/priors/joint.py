"""The joint texture prior: high on textured tissue without highlights. `H, W` image size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .salience import Border, salience
from .specular import specular_likelihood


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
        border: see `salience`.
    Returns:
        (H, W) prior in [0, 1]; 0 off the tissue, and everywhere when the mask is empty.
    Raises:
        ValueError: a shape or type differs, or a color is not finite or outside [0, 1].
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
