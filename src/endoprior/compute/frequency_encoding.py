"""Numbers as sines and cosines of several frequencies, for networks that take places and times."""

from __future__ import annotations

import torch
from torch import Tensor


def encoded_size(dims: int, num: int) -> int:
    """Length of the encoding of `dims` numbers with `num` frequencies."""
    return dims * (1 + 2 * num)


def encoded(x: Tensor, num: int) -> Tensor:
    """(..., D (1 + 2 num)) x (..., D), then sin(2^k x) and cos(2^k x) for k < `num`: NeRF's encoding without factor pi.

    A small network cannot fit fine detail of its raw inputs.
    """
    waves = [wave(x * 2.0**k) for k in range(num) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], -1)
