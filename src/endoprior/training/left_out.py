"""How much of each training frame was left out as a missed tool in its last visits: which masks are likely wrong.

`F` training frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

VISITS = 4
"""Number of visits that are kept of each frame: early ones show what the scene had not learned yet."""
LEAST_SHARE = 0.005
"""Share of the view above which a visit speaks for a missed tool: about 40 px square at 640x512."""
LEAST_VISITS = 2
"""So many of the last visits must; a single one may be a highlight."""


def at_start(num_frames: int) -> Tensor:
    """(F, VISITS) float32 nothing left out."""
    return torch.zeros(num_frames, VISITS)


def record(shares: Tensor, position: int, share: float) -> None:
    """Append a visit of frame number `position`, and forget its oldest one.

    Args:
        shares: (F, VISITS) oldest first; changed in place.
        share: of the view that did not count, 0..1.
    """
    shares[position] = torch.cat((shares[position, 1:], shares.new_tensor([share])))


def missed_tool_frames(shares: Tensor, indices: Sequence[int]) -> tuple[int, ...]:
    """The frames whose masks likely miss a tool, ascending.

    Args:
        shares: (F, VISITS).
        indices: number of each training frame in the sequence.
    """
    often = (shares > LEAST_SHARE).sum(1) >= LEAST_VISITS
    return tuple(index for index, missed in zip(indices, often.tolist(), strict=True) if missed)
