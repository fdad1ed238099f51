"""Terms of SurgicalGaussian's loss: structural similarity, and neighbors that keep their distance and their shape."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from ..render.projection import rotation_matrices

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
TINY = 1e-20
"""Keeps the gradient of a length finite at 0."""


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two images (H, W, 3), (): Gaussian window of 11 px, zeros outside the frame."""
    places = torch.arange(WINDOW, dtype=image.dtype, device=image.device) - WINDOW // 2
    line = torch.exp(-0.5 * (places / SIGMA) ** 2)
    line = line / line.sum()

    def smooth(values: Tensor) -> Tensor:
        rows = conv2d(values, line.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))
        return conv2d(rows, line.view(1, 1, 1, -1), padding=(0, WINDOW // 2))

    a, b = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    mean_a, mean_b = smooth(a), smooth(b)
    variance_a, variance_b = smooth(a * a) - mean_a**2, smooth(b * b) - mean_b**2
    covariance = smooth(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return (luminance * (2 * covariance + C2) / (variance_a + variance_b + C2)).mean()


def distance_change(before: Tensor, after: Tensor, neighbors: Tensor) -> Tensor:
    """Mean absolute change of the distance between each of N vectors (N, D) and its neighbors (N, K), ()."""
    lengths = [((values[:, None] - values[neighbors]) ** 2).sum(-1).add(TINY).sqrt() for values in (before, after)]
    return (lengths[0] - lengths[1]).abs().mean()


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """(N, 6) upper triangle of R S S R^T, from quaternions (N, 4) of any length but zero and scales (N, 3)."""
    axes = rotation_matrices(quats) * scales[:, None, :]
    full = axes @ axes.transpose(1, 2)
    i, j = torch.triu_indices(3, 3, device=full.device)
    return full[:, i, j]
