"""Errors of an estimated camera path against the true one: where the camera was, and how it turned.

The two paths may lie in different world axes: the estimated one is aligned first. `T` frames; poses are
camera-to-world, OpenCV axes.

Alignment: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
Absolute and relative error: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape
from ...core.geometry import camera_to_world
from ..context import EvaluationContext
from ..score import Score

AXIS_MM = 1e-3
"""Each camera axis counts as a point this far from the camera's center when paths are aligned, mm.

Far too little to matter where the camera moves, enough to decide what its centers leave open: the turn about a straight
path, or every turn of a camera at rest. A true path whose RMS distance from its mean is smaller is at rest."""
ROUNDING = 1e-12  # An estimated path is at rest if its extent is below this share of its largest coordinate
SCORES = (
    Score(
        "ate_mm", "camera path error", "mm", False, 3,
        "Root mean square distance of camera centers from the true ones, after alignment; with ground truth only.",
        group="motion", hint="0 is the true path", in_true_mm=True,
    ),
    Score(
        "rpe_mm", "camera step error", "mm", False, 3,
        "Root mean square error of the camera's translation from frame to frame.",
        group="motion", in_summary=False, in_true_mm=True,
    ),
    Score(
        "rpe_deg", "camera turn error", "deg", False, 3,
        "Mean angle by which the camera's turn from frame to frame is wrong.",
        group="motion", hint="0 turns as the true camera",
    ),
    Score(
        "rotation_error_deg", "camera rotation error", "deg", False, 3,
        "Mean angle between the camera's axes and the true ones, after alignment.",
        group="motion", in_summary=False,
    ),
)  # fmt: skip
ONE_FRAME = "a single frame has no motion"


def compute(context: EvaluationContext) -> None:
    """Compare the cameras of all frames, whatever the split; nothing without the true path, or a given one."""
    if context.true_path is None:
        return
    scene = context.rendered_scene
    errors = trajectory_errors(camera_to_world(scene.cameras), context.true_path, scene.lengths_are_relative)
    for score in SCORES:
        context.add(score.name, getattr(errors, score.name), ONE_FRAME)


class TrajectoryErrors(NamedTuple):
    """Errors of a camera path after alignment; lengths in mm of the true path."""

    ate_mm: float  # Absolute trajectory error: root mean square distance of aligned and true camera centers
    rpe_mm: float
    """Relative pose error: root mean square length by which the motion from frame to frame is wrong; NaN if T = 1."""
    rpe_deg: float
    """Arithmetic mean, not root mean square, of the angle by which that motion is wrong, degrees; NaN if T = 1."""
    rotation_error_deg: float  # Arithmetic mean over frames of the angle between aligned and true camera axes, degrees
    scale: float  # Factor of the estimated lengths in the alignment; 1 without scale


def trajectory_errors(
    estimated: NDArray[np.floating], true: NDArray[np.floating], with_scale: bool
) -> TrajectoryErrors:
    """Align the estimated path (T, 4, 4) with the true one, mm, and compare them: `with_scale` by Sim(3), else by
    SE(3).

    The relative error of frames i, i + 1 is (Q_i^-1 Q_{i+1})^-1 (P_i^-1 P_{i+1}), with Q the true and P the estimated
    poses, whose lengths are scaled. It depends on no world axes. Two frames say little of a path: with scale, their
    absolute error is always 0.
    """
    estimated, true = np.asarray(estimated, np.float64), np.asarray(true, np.float64)
    check_shape("estimated:T,4,4 true:T,4,4", estimated=estimated, true=true)
    scale, rotation, translation = align_paths(estimated, true, with_scale)
    centers = scale * estimated[:, :3, 3] @ rotation.T + translation
    # (T - 1, 4, 4) pose of each next camera in the axes of the one before.
    motion, true_motion = (np.linalg.solve(poses[:-1], poses[1:]) for poses in (estimated, true))
    wrong_mm = np.linalg.norm(scale * motion[:, :3, 3] - true_motion[:, :3, 3], axis=-1)
    wrong_deg = _angles_deg(true_motion[:, :3, :3].transpose(0, 2, 1) @ motion[:, :3, :3])
    turned_deg = _angles_deg(true[:, :3, :3].transpose(0, 2, 1) @ rotation @ estimated[:, :3, :3])
    return TrajectoryErrors(
        ate_mm=_rms(np.linalg.norm(centers - true[:, :3, 3], axis=-1)),
        rpe_mm=_rms(wrong_mm),
        rpe_deg=float(wrong_deg.mean()) if wrong_deg.size else float("nan"),
        rotation_error_deg=float(turned_deg.mean()),
        scale=scale,
    )


def align_paths(
    estimated: NDArray[np.float64], true: NDArray[np.float64], with_scale: bool
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Scale, rotation (3, 3), never a reflection, and translation (3,), mm, that move estimated centers to true ones.

    It minimizes the sum of squared distances. Where centers leave the rotation open (a camera at rest, a straight path,
    two frames), the axes of the cameras decide it, each counted as a point `AXIS_MM` from the center. A scale that
    nothing determines, because one of the two cameras is at rest, is 1.
    """
    mean, true_mean = estimated[:, :3, 3].mean(0), true[:, :3, 3].mean(0)
    points, true_points = estimated[:, :3, 3] - mean, true[:, :3, 3] - true_mean
    extent, true_extent = np.sqrt((points**2).sum(1).mean()), np.sqrt((true_points**2).sum(1).mean())
    moves = extent > ROUNDING * np.abs(estimated[:, :3, 3]).max()
    # In the length of the true path, so that the unit of the estimated one does not matter.
    covariance = np.zeros((3, 3))
    if moves:
        covariance = true_points.T @ (points / extent) * (true_extent / len(points))
    axes = np.einsum("tij,tkj->ik", true[:, :3, :3], estimated[:, :3, :3]) / len(points)
    u, _, vt = np.linalg.svd(covariance + AXIS_MM**2 * axes)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt  # of determinant 1 and the largest trace
    scale = 1.0
    if with_scale and moves and true_extent > AXIS_MM:
        scale = max(float((rotation * covariance).sum()), 0.0) / (true_extent * extent)
    return scale, rotation, true_mean - scale * rotation @ mean


def _angles_deg(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T,) angles of (T, 3, 3) rotations, degrees; exact for small ones, where an arc cosine is not."""
    skew = rotations - rotations.transpose(0, 2, 1)
    sine = np.sqrt((skew**2).sum((1, 2)) / 8)
    return np.rad2deg(np.arctan2(sine, (np.trace(rotations, axis1=1, axis2=2) - 1) / 2))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")
