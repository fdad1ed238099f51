"""Refinement of camera poses during training: the part of the config. See `config.py`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from .ranges import Checked, Count, Positive, Range, Rate, Share, Weight


@dataclass(frozen=True)
class PoseConfig(Checked):
    """Camera poses that are trained with the scene; only where the camera moves."""

    refine: Literal["never", "estimated", "always"] = "never"
    """`estimated`: only poses that a program found in the video; given poses stay as they are."""
    start_iteration: Count = 200
    """First fine iteration that changes a pose."""
    turn_rate_rad: Rate = 1e-4
    """Adam's rate of rotations; it decays as `optim.basis_decay` says."""
    shift_rate_mm: Rate = 1e-2
    """Adam's rate of translations."""
    smooth_weight: Weight = 1e-3
    """Weight of the squared difference between a frame's correction and the mean of its neighbors', ..."""
    turn_unit_rad: Annotated[float, Range(1e-9, 1e3)] = 2e-3
    """... rotations in units of this ..."""
    shift_unit_mm: Annotated[float, Range(1e-9, 1e6)] = 0.2
    """... and translations of this."""
    check_every: Positive = 100
    """After so many iterations, corrections that explain held-out tracks worse than before are undone."""
    worse: Share = 0.01
    """Worse is a median error greater by more than this share."""
