"""RAFT (Teed and Deng 2020) as a flow estimator, through torchvision: the published flow error's network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape
from .torchvision_compat import import_torchvision
from .weights import RAFT_LARGE, RAFT_SMALL, ScoreUnavailable, find_weights, select_weights

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

NUM_UPDATES = 12
"""Refinements of the flow; the last one is used, as published."""
SIDE_MULTIPLE = 8
"""RAFT works at 1/8 of the resolution, so sides are padded to multiples of this, px."""
MIN_SIZE = 128
"""Shortest side for which RAFT's correlation pyramid has a pixel left at its coarsest level, px."""


@dataclass(frozen=True)
class RaftFlow:
    """A flow estimator: torchvision's RAFT in evaluation mode with its default input scaling."""

    network: Module

    def __call__(self, first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W, 2) displacement (x, y) in px from `first` to `second`, both (H, W, 3) 8-bit RGB.

        Sides that are not a multiple of 8 are padded at the right and bottom by the last column and row; the flow is
        cropped to the image.

        Raises:
            ValueError: shapes differ.
            ScoreUnavailable: a side is shorter than `MIN_SIZE`.
        """
        import torch

        size = check_shape("first:H,W,3 second:H,W,3", first=first, second=second)
        height, width = size["H"], size["W"]
        if min(height, width) < MIN_SIZE:
            raise ScoreUnavailable(f"RAFT needs images of at least {MIN_SIZE} px a side; got {width}x{height}")
        a, b = (_network_input(image) for image in (first, second))
        with torch.inference_mode():
            flow = self.network(a, b, num_flow_updates=NUM_UPDATES)[-1][0]
        return flow.permute(1, 2, 0)[:height, :width].numpy()


def _network_input(image: NDArray[np.uint8]) -> Tensor:
    """(1, 3, H', W') image in [-1, 1] as torchvision's preset scales it, sides padded to multiples of 8."""
    import torch

    height, width = image.shape[:2]
    padded = np.pad(image, ((0, -height % SIDE_MULTIPLE), (0, -width % SIDE_MULTIPLE), (0, 0)), mode="edge")
    return torch.from_numpy(padded).permute(2, 0, 1)[None].float() / 127.5 - 1


def raft_flow(
    variant: Literal["large", "small"] = "large",
    weights_dir: Path | None = None,
    *,
    download: bool = True,
) -> RaftFlow:
    """Load RAFT. "large" is the published score's network; "small" has a score of its own.

    Args:
        variant: which network.
        weights_dir: folder to look in first; see `weights.find_weights`.
        download: False never touches the network.
    Raises:
        InputError: `weights_dir` or `ENDOPRIOR_WEIGHTS` is not a folder.
        ScoreUnavailable: torchvision or the weights are missing, with the reason.
    """
    import torch

    models = import_torchvision().models.optical_flow
    found = find_weights(RAFT_LARGE if variant == "large" else RAFT_SMALL, weights_dir, download=download)
    # A new network has random weights; creating them must not change the caller's random numbers.
    with torch.random.fork_rng(devices=[]):
        network = (models.raft_large if variant == "large" else models.raft_small)(weights=None)
    state = network.state_dict()
    network.load_state_dict(select_weights(found, state, {name: name for name in state}))
    return RaftFlow(network.eval().requires_grad_(False))
