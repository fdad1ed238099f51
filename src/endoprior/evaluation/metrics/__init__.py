"""Scores: pure functions of NumPy arrays, one frame or one pair of frames at a time.

A frame on which a score is undefined (an empty mask, no measured depth) scores NaN. `mean_over_frames` ignores such
frames, and returns NaN if none is left. A score whose network or weights are missing raises `ScoreUnavailable`, whose
text is the reason to print; nothing else is measured in its place. Torch, torchvision and lpips are imported only when
a score needs them.
"""

from __future__ import annotations

from .flow import FlowEstimator, dis_flow, flow_error
from .frames import mean_over_frames
from .image import (
    depth_rmse,
    depth_rmse_8bit,
    depth_rmse_endogaussian,
    psnr,
    psnr_behind_tool,
    psnr_tissue,
    ssim,
    ssim_tissue,
    ssim_valid,
    to_uint8,
)
from .lpips import LpipsDistance, lpips_distance
from .pooled import SquaredErrors, pooled_psnr, pooled_rmse, squared_errors
from .raft import raft_flow
from .stability import depth_instability
from .track_accuracy import track_accuracy
from .tracks import TrackError, neighbor_breaks, track_error
from .trajectory import TrajectoryErrors, trajectory_errors
from .weights import ScoreUnavailable, WeightsMissing

__all__ = [
    "FlowEstimator",
    "LpipsDistance",
    "ScoreUnavailable",
    "SquaredErrors",
    "TrackError",
    "TrajectoryErrors",
    "WeightsMissing",
    "depth_instability",
    "depth_rmse",
    "depth_rmse_8bit",
    "depth_rmse_endogaussian",
    "dis_flow",
    "flow_error",
    "lpips_distance",
    "mean_over_frames",
    "neighbor_breaks",
    "pooled_psnr",
    "pooled_rmse",
    "psnr",
    "psnr_behind_tool",
    "psnr_tissue",
    "raft_flow",
    "squared_errors",
    "ssim",
    "ssim_tissue",
    "ssim_valid",
    "to_uint8",
    "track_accuracy",
    "track_error",
    "trajectory_errors",
]
