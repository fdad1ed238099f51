"""Terms of SurgicalGaussian's loss: structural similarity, and neighbors that keep their distance and their shape."""

from __future__ import annotations

from typing import Any

import cv2
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from endoprior.render.projection import rotation_matrices

WINDOW, SIGMA = 11, 1.5
LINE = cv2.getGaussianKernel(WINDOW, SIGMA)
"""(11, 1) the window along one axis."""
C1, C2 = 0.01**2, 0.03**2
TINY = 1e-20
"""Keeps the gradient of a length finite at 0."""


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two images (H, W, 3), (): Gaussian window of 11 px, zeros outside the frame."""
    smooth = _Smoothed.apply if image.device.type == "cpu" else smoothed
    mean_a, mean_b = smooth(image), smooth(target)
    variance_a, variance_b = smooth(image * image) - mean_a**2, smooth(target * target) - mean_b**2
    covariance = smooth(image * target) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return (luminance * (2 * covariance + C2) / (variance_a + variance_b + C2)).mean()


def smoothed(values: Tensor) -> Tensor:
    """(H, W, 3) values weighted by the window around each pixel; zeros outside."""
    line = torch.as_tensor(LINE, dtype=values.dtype, device=values.device)
    rows = conv2d(values.permute(2, 0, 1)[:, None], line.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))
    return conv2d(rows, line.view(1, 1, 1, -1), padding=(0, WINDOW // 2))[:, 0].permute(1, 2, 0)


class _Smoothed(torch.autograd.Function):
    """`smoothed` by OpenCV, many times faster on a CPU. The window is symmetric, so it is its own gradient."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return _by_opencv(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> Tensor:
        return _by_opencv(v_out)


def _by_opencv(values: Tensor) -> Tensor:
    array = values.detach().contiguous().numpy()
    return torch.from_numpy(cv2.sepFilter2D(array, -1, LINE, LINE, borderType=cv2.BORDER_CONSTANT))


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
