"""EndoNeRF's correction of measured depth: where it is farthest from the rendered one, the rendered one is taken."""

from __future__ import annotations

import torch
from torch import Tensor

ROUNDS, OUTLIERS = 4, 0.1


def due(iteration: int, every: int) -> bool:
    """Whether depth is refined after this iteration."""
    return every > 0 and iteration % every == 0 and iteration // every <= ROUNDS


def refined(measured: Tensor, rendered: Tensor, tissue: Tensor) -> Tensor:
    """(H, W) depth, mm, in which the worst tenth of all pixels has the rendered depth.

    Args:
        measured: (H, W) mm, 0 where missing. rendered: (H, W) mm. tissue: (H, W) bool; other pixels count as right.
    """
    error = torch.where(tissue, (rendered - measured).square(), torch.zeros_like(measured))
    limit = error.flatten().kthvalue(max(1, round((1 - OUTLIERS) * error.numel()))).values
    return torch.where(error > limit, rendered, measured)
