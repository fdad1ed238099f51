"""State of Adam for one parameter (Kingma and Ba, 2015); `adam_numba.py` and `adam_torch.py` do the steps."""

from __future__ import annotations

import torch
from torch import Tensor

BETA1, BETA2 = 0.9, 0.999


class AdamState:
    """Moments of one parameter and its number of steps; a temporal basis counts the steps of each basis function."""

    def __init__(self, param: Tensor, num_counts: int = 1) -> None:
        """Start with zero moments.

        Args:
            num_counts: B for a temporal basis, else 1.
        """
        self.first = torch.zeros_like(param, requires_grad=False)
        self.second = torch.zeros_like(param, requires_grad=False)
        self.steps = torch.zeros(num_counts, device=param.device)
        """(num_counts,) whole numbers."""

    def arrays(self) -> dict[str, Tensor]:
        """Moments and step counts by name."""
        return {"first": self.first, "second": self.second, "steps": self.steps.to(torch.int64)}

    def load(self, arrays: dict[str, Tensor]) -> None:
        """Copy in what `arrays` gave."""
        for name, value in arrays.items():
            getattr(self, name).copy_(value)
