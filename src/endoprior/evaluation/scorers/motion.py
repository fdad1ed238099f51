"""Whether the rendered video moves as the true one does: the paper's temporal score, and motion that is only color.

Flow error compares the optical flow between two true frames with that between the two rendered ones. The estimator is
part of the score's name: `flow_error` (RAFT-large, as published), `flow_error_raft_small`, `flow_error_dis`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape
from ...core.types import Frame
from ...footage.image_operations import Image, Mask
from ...footage.optical_flow import MIN_SIZE_PX, dense_flow, gray_for_flow
from ...model.colors import changes_color, with_fixed_color
from ...system.parallel import frame_threads
from ..context import NETWORKS_OFF, EvaluationContext, SceneFrames
from ..networks import RAFT_LARGE, RAFT_SMALL, find_weights, import_torchvision, select_weights
from ..score import Score, ScoreUnavailable

if TYPE_CHECKING:
    from torch.nn import Module

BYTES_PER_PX = 120  # memory in which a thread compares two flows, bytes for each px
RAFT_UPDATES = 12  # Refinements of RAFT's flow; the last one is used, as published
RAFT_SIDE_MULTIPLE, RAFT_MIN_SIZE = 8, 128
"""Sides are padded to multiples of the first, px; below the second RAFT's coarsest level has no pixel left."""
FlowEstimator = Callable[[Image, Image], NDArray[np.float32]]
"""Gives the (H, W, 2) displacement (x, y) in px from the first to the second of two (H, W, 3) 8-bit RGB images."""
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
        group="motion", in_summary=False, stands_for="flow_error",
    ),
    Score(
        "flow_error_dis_adjacent", "flow error, adjacent (DIS)", "px", False, 3,
        "The same by DIS, between all adjacent frames of the video.",
        group="motion", in_summary=False,
    ),
    Score(
        "color_share", "change by color", "", False, 3,
        "Share of the change of rendered tissue over time that is lost when colors are fixed: motion does not make it.",
        compare="absolute", group="motion", hint="0: all by motion; 1: nothing moves",
    ),
)  # fmt: skip


def compute(context: EvaluationContext) -> None:
    """Score consecutive frames of the split, with DIS also adjacent frames of the video; and the share of color."""
    with context.skip_if_unavailable("flow_error_dis"):
        _add(context, "flow_error_dis", context.frames, dis_flow)
    if context.networks:
        with context.skip_if_unavailable("flow_error"):
            raft_large = raft_flow("large", context.weights_dir, download=context.download)
            _add(context, "flow_error", context.frames, raft_large)
        with context.skip_if_unavailable("flow_error_raft_small"):
            raft_small = raft_flow("small", context.weights_dir, download=False)
            _add(context, "flow_error_raft_small", context.frames, raft_small)
    else:
        context.skip("flow_error", NETWORKS_OFF)
    with context.skip_if_unavailable("flow_error_dis_adjacent"):
        _add(context, "flow_error_dis_adjacent", context.video, dis_flow)
    with context.skip_if_unavailable("color_share"):
        context.add("color_share", color_share(context))


def _add(context: EvaluationContext, name: str, frames: Sequence[Frame], estimator: FlowEstimator) -> None:
    """Add the mean error over pairs of neighbors in `frames`: over a test split they are 8 frames apart, as published.
    In `per_frame` a pair of the split stands at its first frame.
    """

    def error(pair: tuple[list[Frame], list[Image]]) -> float:
        frames, rendered = pair
        return flow_error(rendered, [each.rgb_u8 for each in frames], [each.tissue_mask for each in frames], estimator)

    pairs = (([*pair], [context.rendered[frame.index].rgb_u8 for frame in pair]) for pair in pairwise(frames))
    if estimator is dis_flow:
        with frame_threads(BYTES_PER_PX * frames[0].tissue_mask.size if frames else 1) as pool:
            errors = list(pool.map(error, pairs))
    else:  # a network computes with all threads
        errors = list(map(error, pairs))
    reason = "no two neighboring frames share tissue"
    if frames is context.frames:
        context.add_frames([{name: error} for error in (*errors, math.nan)], reason)
    else:
        context.add_mean(name, errors, reason)


def color_share(context: EvaluationContext) -> float:
    """Share of the change in the rendered split that is color changing with time; ScoreUnavailable without change."""
    scene = context.scene
    if not changes_color(scene):
        raise ScoreUnavailable("the colors of this scene do not change with time")
    fixed = SceneFrames(with_fixed_color(scene, [frame.time for frame in context.frames]), context.sequence)
    by_color = count = total = squares = np.float64(0)
    for frame in context.frames:
        mask = frame.tissue_mask[..., None]
        image = np.float64(mask) * context.rendered[frame.index].color
        by_color += (mask * (image - fixed.render(frame.index)[0]) ** 2).sum()
        count, total, squares = count + mask, total + image, squares + image**2
    change = (squares - total**2 / np.maximum(count, 1)).sum()  # over time, around the mean of each pixel
    if change <= 1e-12 * squares.sum():
        raise ScoreUnavailable("nothing changes in the rendered frames of the split")
    return float(by_color / change)


def dis_flow(first: Image, second: Image) -> NDArray[np.float32]:
    """Dense inverse search on gray images; see `FlowEstimator`. ScoreUnavailable below `MIN_SIZE_PX`."""
    if min(first.shape[:2]) < MIN_SIZE_PX:
        height, width = first.shape[:2]
        raise ScoreUnavailable(f"DIS flow needs images of at least {MIN_SIZE_PX} px a side; got {width}x{height}")
    return dense_flow(gray_for_flow(first, 1), gray_for_flow(second, 1))


def flow_error(
    renders: Sequence[Image], targets: Sequence[Image], masks: Sequence[Mask], estimator: FlowEstimator
) -> float:
    """Mean end-point distance between rendered and true flow of a pair of frames (H, W, 3), px; NaN without common
    tissue. All images are multiplied by their tissue mask first, and a pixel counts where both frames show tissue.
    """
    both = masks[0] & masks[1]
    if not both.any():
        return math.nan
    rendered, true = (
        estimator(*(image * mask[..., None] for image, mask in zip(images, masks, strict=True)))
        for images in (renders, targets)
    )
    return float(np.linalg.norm((rendered - true)[both].astype(np.float64), axis=-1).mean())


@dataclass(frozen=True)
class RaftFlow:
    """RAFT (Teed and Deng 2020) as a `FlowEstimator`: torchvision's, in evaluation mode, with its input scaling."""

    network: Module

    def __call__(self, first: Image, second: Image) -> NDArray[np.float32]:
        """Sides that are not a multiple of 8 are padded at the right and bottom by the last column and row."""
        import torch

        size = check_shape("first:H,W,3 second:H,W,3", first=first, second=second)
        height, width = size["H"], size["W"]
        if min(height, width) < RAFT_MIN_SIZE:
            raise ScoreUnavailable(f"RAFT needs images of at least {RAFT_MIN_SIZE} px a side; got {width}x{height}")
        pad = ((0, -height % RAFT_SIDE_MULTIPLE), (0, -width % RAFT_SIDE_MULTIPLE), (0, 0))
        padded = (torch.from_numpy(np.pad(image, pad, mode="edge")) for image in (first, second))
        a, b = (image.permute(2, 0, 1)[None].float() / 127.5 - 1 for image in padded)  # as torchvision's preset scales
        with torch.inference_mode():
            flow = self.network(a, b, num_flow_updates=RAFT_UPDATES)[-1][0]
        return flow.permute(1, 2, 0)[:height, :width].numpy()


def raft_flow(
    variant: Literal["large", "small"], weights_dir: Path | None = None, *, download: bool = True
) -> RaftFlow:
    """Load RAFT. Arguments and errors as `find_weights`; ScoreUnavailable without torchvision."""
    import torch

    models = import_torchvision().models.optical_flow
    found = find_weights(RAFT_LARGE if variant == "large" else RAFT_SMALL, weights_dir, download=download)
    # A new network has random weights; creating them must not change the caller's random numbers.
    with torch.random.fork_rng(devices=[]):
        network = (models.raft_large if variant == "large" else models.raft_small)(weights=None)
    state = network.state_dict()
    network.load_state_dict(select_weights(found, state, {name: name for name in state}))
    return RaftFlow(network.eval().requires_grad_(False))
