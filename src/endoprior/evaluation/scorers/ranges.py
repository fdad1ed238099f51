"""Whether the ranges of carried points hold as many true positions as they say; needs true tracks of the whole video.

Each point is picked as a user would, at its pixel in the first frame that shows it, on the rendered surface. `T`
frames, `P` points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...core.geometry import camera_to_world, unit_vectors
from ...core.types import frame_times
from ...model.carry import carry
from ...model.surface import surface_points
from ...model.uncertainty import PointErrors, point_errors
from ..context import EvaluationContext
from ..score import Score
from .tracks import NO_TRACKS, true_tracks

SEEN = (
    Score(
        "range_held_95", "in 95 % range", "", None, 3,
        "Share of true positions inside of the 95 % range of the carried point, along each of three axes.",
        compare="absolute", group="motion", hint="0.95: as said",
    ),
    Score(
        "range_held_80", "in 80 % range", "", None, 3,
        "The same of the 80 % range.",
        compare="absolute", group="motion", in_summary=False,
    ),
    Score(
        "range_held_50", "in 50 % range", "", None, 3,
        "The same of the 50 % range.",
        compare="absolute", group="motion", in_summary=False,
    ),
)  # fmt: skip
HIDDEN = tuple(
    score.variant("hidden", "hidden", "points that the frame does not show", in_summary=score.in_summary)
    for score in SEEN
)
SCORES = SEEN + HIDDEN


def compute(context: EvaluationContext) -> None:
    """Count true positions inside of the ranges; nothing without ground truth."""
    sequence = context.sequence
    if sequence.truth is None:
        return
    scene, true = context.scene, true_tracks(sequence)
    if true is None:
        for score in SCORES:
            context.skip(score.name, NO_TRACKS)
        return
    first = true.first
    starts = surface_points(scene, true.at_start(true.pixels), first)
    known = np.flatnonzero(np.isfinite(starts).all(1))
    times = frame_times(len(sequence))
    carried = carry(scene, starts[known], first[known], times)
    errors = point_errors(scene, carried, first[known], range(len(sequence)))
    pose = camera_to_world(sequence.camera(i) for i in range(len(sequence)))
    world = np.einsum("tij,tpj->tpi", pose[:, :3, :3], true.points[:, known]) + pose[:, None, :3, 3]
    off, counted = carried.positions - world, true.counted[:, known]
    visible = true.visible[:, known]
    for scores, where in ((SEEN, counted & visible), (HIDDEN, counted & ~visible)):
        for score in scores:
            level = int(score.name.split("_")[2]) / 100
            context.add(score.name, share_held(off, errors, pose[:, :3, 1], level, where), "no such point")


def share_held(off: NDArray, errors: PointErrors, down: NDArray, level: float, where: NDArray[np.bool_]) -> float:
    """Share of errors (T, P, 3), mm, world axes, that are inside of their ranges, along the ray and both axes across;
    NaN if nothing is `where` (T, P).

    Args:
        down: (T, 3) y axis of the camera of each frame, world axes.
    """
    if not where.any():
        return math.nan
    side = unit_vectors(np.cross(errors.rays, down[:, None]))
    axes = errors.rays, side, np.cross(errors.rays, side)
    held = [np.abs((off * axis).sum(-1)) <= errors.half_width(axis, level) for axis in axes]
    return float(np.stack(held)[:, where].mean())
