"""Measure whether the stored camera poses explain the images."""

from __future__ import annotations

import numpy as np

from ..data import FrameSequence
from ..footage.pose_fit import PoseFit, View, measure_poses


def measure_pose_fit(sequence: FrameSequence) -> PoseFit | None:
    """Reproject depth between frames with the stored poses; None for a static camera or without enough corners."""
    first = sequence.camera(0)

    def view(index: int) -> View:
        frame = sequence.frame(index)
        return frame.rgb_u8, frame.tissue_mask, np.where(frame.depth_valid, frame.depth, np.float32(0))

    matrix = np.array([[first.fx, 0, first.cx - 0.5], [0, first.fy, first.cy - 0.5], [0, 0, 1]])
    poses = np.linalg.inv(np.array([sequence.camera(i).world_to_camera for i in range(len(sequence))]))
    return measure_poses(view, matrix, poses, relative=sequence.depth_is_relative)
