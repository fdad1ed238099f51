"""How sure a measured depth is: its partners, measured on their own, must see the same surface there.

Tissue or a tool that moves by itself has another depth for every pair of frames, so it agrees with few of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera_path.even_view import Warp

TOLERANCE = 0.02  # relative difference of two measured depths that halves their agreement
MATCH_PX = 0.25  # standard deviation of a match, px of a fine view
NEEDED = 2.0  # agreement, summed over the partners, from which a depth is sure
SUPPORT, SUPPORT_PX = 0.3, 5.0
"""Mean confidence of a neighborhood from which it supports a pixel, and its standard deviation, px of a fine view: what
is sure alone among what is not has met its like by chance."""


def checked(
    inverse: NDArray[np.float32],
    score: NDArray[np.float32],
    warps: Sequence[Warp],
    others: Sequence[NDArray[np.float32]],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) inverse depth, averaged with that of the partners that agree, and (h, w) confidence in [0, 1].

    Confidence is the product of four terms: agreement, sum over the partners of 1 / (1 + (difference / 2 %)^2), of two
    that are needed; precision, 1 / (1 + (error of a match / 2 %)^2) with the depth error that `MATCH_PX` makes; the
    correlation of the images; and the support of the neighborhood.

    Args:
        inverse, score: (h, w) of the frame, see `Sweep.inverse_depth`.
        warps, others: to each partner, and (h, w) its own inverse depth.
    """
    total, weight = inverse.copy(), np.ones_like(inverse)
    agreement, precision = np.zeros_like(inverse), np.zeros_like(inverse)
    for warp, other in zip(warps, others, strict=True):
        x, y, expected = warp.at(inverse)
        seen = cv2.remap(other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        ratio = seen / np.maximum(expected, np.float32(1e-9))
        agrees = np.where(seen > 0, 1 / (1 + ((ratio - 1) / TOLERANCE) ** 2), 0).astype(np.float32)
        total += agrees * ratio * inverse
        weight += agrees
        agreement += agrees
        nearer_x, nearer_y, _ = warp.at(inverse * np.float32(1 + TOLERANCE))
        shift_px = np.hypot(nearer_x - x, nearer_y - y)
        precision = np.maximum(precision, 1 / (1 + (MATCH_PX / np.maximum(shift_px, 1e-6)) ** 2))
    sure = np.minimum(agreement / NEEDED, 1)
    alone = (sure * precision * np.clip(score, 0, 1)).astype(np.float32)
    support = np.minimum(cv2.GaussianBlur(alone, (0, 0), SUPPORT_PX) / np.float32(SUPPORT), 1)
    return total / weight, alone * support
