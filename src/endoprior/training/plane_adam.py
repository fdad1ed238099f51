"""State of Adam for the planes of a HexPlane field, of which most cells never get a gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from ..model.hexplane import TOUCHED, PlaneGrid


class PlaneAdam:
    """Moments of the planes; they take memory only where cells are touched."""

    def __init__(self, grid: PlaneGrid, epsilon: float) -> None:
        """Start with zero moments at step 0."""
        self.grid, self.epsilon = grid, epsilon
        self.steps = torch.zeros((), device=grid.values.device)
        """() a whole number."""
        self.exp_avg, self.exp_avg_sq = grid.zeros(), grid.zeros()

    def arrays(self) -> dict[str, Tensor]:
        """Marks of all cells, moments of the touched ones (in order of cells) and the step count."""
        touched = self.grid.marks.nonzero()[:, 0]
        return {
            "marks": self.grid.marks & TOUCHED,
            "exp_avg": self.exp_avg[touched],
            "exp_avg_sq": self.exp_avg_sq[touched],
            "steps": self.steps.to(torch.int64).reshape(1),
        }

    def load(self, arrays: dict[str, Tensor]) -> None:
        """Copy in what `arrays` gave; gradients that no step consumed are dropped."""
        self.grid.clear_grads()
        self.grid.marks.copy_(arrays["marks"])
        touched = self.grid.marks.nonzero()[:, 0]
        self.exp_avg.zero_()
        self.exp_avg_sq.zero_()
        self.exp_avg[touched] = arrays["exp_avg"].to(touched.device)
        self.exp_avg_sq[touched] = arrays["exp_avg_sq"].to(touched.device)
        self.steps.copy_(arrays["steps"][0])
