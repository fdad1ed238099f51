"""Flow error: whether the rendered video moves as the true one does, by several estimators of optical flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from ...core.types import Frame
from .. import metrics
from ..context import NETWORKS_OFF, EvaluationContext
from ..score import Score

SCORES = (
    Score(
        "flow_error_dis", "flow error (DIS)", "px", False, 3,
        "Difference of rendered and true optical flow between consecutive frames of the split, by OpenCV's DIS.",
        group="motion", hint="0 moves as the video does",
    ),
    Score(
        "flow_error", "flow error", "px", False, 3,
        "The published one: the same by RAFT-large; needs its weights.",
        group="motion", hint="0 moves as the video does",
    ),
    Score(
        "flow_error_raft_small", "flow error (RAFT-small)", "px", False, 3,
        "The same by RAFT-small, where its weights are on this machine.",
        group="motion", in_summary=False,
    ),
    Score(
        "flow_error_dis_adjacent", "flow error, adjacent (DIS)", "px", False, 3,
        "The same by DIS, between all adjacent frames of the video.",
        group="motion", in_summary=False,
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score consecutive frames of the split; with DIS also adjacent frames of the video."""
    with context.skip_if_unavailable("flow_error_dis"):
        _add(context, "flow_error_dis", context.frames, metrics.dis_flow)
    if context.networks:
        with context.skip_if_unavailable("flow_error"):
            _add(context, "flow_error", context.frames, metrics.raft_flow("large", context.weights_dir))
        with context.skip_if_unavailable("flow_error_raft_small"):
            raft_small = metrics.raft_flow("small", context.weights_dir, download=False)
            _add(context, "flow_error_raft_small", context.frames, raft_small)
    else:
        context.skip("flow_error", NETWORKS_OFF)
    with context.skip_if_unavailable("flow_error_dis_adjacent"):
        _add(context, "flow_error_dis_adjacent", context.video, metrics.dis_flow)


def _add(context: EvaluationContext, name: str, frames: Sequence[Frame], estimator: metrics.FlowEstimator) -> None:
    """Add the mean error over pairs of neighbors in `frames`; two frames at a time, which bounds memory.

    In `per_frame` a pair of the split stands at its first frame.
    """
    errors: list[float] = []
    for pair in pairwise(frames):
        rendered, true = [context.rendered[frame.index].rgb_u8 for frame in pair], [frame.rgb_u8 for frame in pair]
        errors += list(metrics.flow_error(rendered, true, [frame.tissue_mask for frame in pair], estimator))
    reason = "no two neighboring frames share tissue"
    if frames is context.frames:
        context.add_frames([{name: error} for error in (*errors, math.nan)], reason)
    else:
        context.add_mean(name, errors, reason)
