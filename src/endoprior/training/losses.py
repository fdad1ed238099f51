"""Supervised terms of the objective, Eq. (12): masked color, inverse depth, total variation.

Pure functions; `H, W` is the image. Weights are applied by the caller.
"""

from __future__ import annotations

import torch
from torch import Tensor


def color_l1(color: Tensor, target: Tensor, tissue_mask: Tensor) -> Tensor:
    """L_rgb: mean absolute color difference over tissue pixels and channels.

    Args:
        color, target: (H, W, 3). tissue_mask: (H, W) bool, True on tissue.
    """
    count = (tissue_mask.sum() * color.shape[-1]).clamp(min=1)
    return ((color - target).abs() * tissue_mask[..., None]).sum() / count


def inverse_depth(depth: Tensor) -> Tensor:
    """1 / depth where depth is not 0, else 0; same shape, 1 / mm."""
    drawn = depth != 0
    return torch.where(drawn, 1 / torch.where(drawn, depth, 1), 0)


def inverse_depth_l1(inverse: Tensor, target: Tensor, measured: Tensor, min_pixels: int) -> Tensor:
    """L_depth: mean absolute difference of inverse depths over measured tissue pixels, 1 / mm.

    Args:
        inverse, target: (H, W) 1 / mm. measured: (H, W) bool, True where tissue has a depth.
        min_pixels: with fewer measured pixels the loss is 0.
    """
    count = measured.sum()
    if min_pixels and count < min_pixels:
        return inverse.new_zeros(())
    return ((inverse - target).abs() * measured).sum() / count.clamp(min=1)


def total_variation(image: Tensor) -> Tensor:
    """Sum of absolute forward differences along both axes, divided by the number of values.

    Args:
        image: (H, W) or (H, W, C).
    """
    down = (image[1:] - image[:-1]).abs().sum()
    right = (image[:, 1:] - image[:, :-1]).abs().sum()
    return (down + right) / image.numel()


def supervised(
    color: Tensor,
    depth: Tensor,
    target_u8: Tensor,
    target_inverse: Tensor,
    tissue_mask: Tensor,
    measured: Tensor,
    weights: tuple[float, float, float],
) -> Tensor:
    """(3,) weighted color, depth and total-variation terms: the definition of `loss_kernels.supervised_losses`."""
    drawn = inverse_depth(depth)
    terms = [
        color_l1(color, target_u8.float() / 255, tissue_mask),
        inverse_depth_l1(drawn, target_inverse, measured, 0),
        total_variation(color) + total_variation(drawn),
    ]
    return torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)])
