"""Texture: the Sobel gradient of the gray image, scaled by a robust maximum. `H, W` image size."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
