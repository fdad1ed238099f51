"""Frequency encoding: a small network cannot fit fine detail of its raw inputs."""

from __future__ import annotations

import torch
from torch import Tensor


def encoded_size(dims: int, num: int) -> int:
    """Length of the encoding of `dims` numbers with `num` frequencies."""
    return dims * (1 + 2 * num)


def encoded(x: Tensor, num: int) -> Tensor:
    """x, then sin(2^k x) and cos(2^k x) for k below `num`: NeRF's encoding, without its factor pi.

    Args:
        x: (..., D).
    Returns:
        (..., D (1 + 2 num)).
    """
    waves = [wave(x * 2.0**k) for k in range(num) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], -1)


def encoded_change(x: Tensor, dx: Tensor, num: int) -> Tensor:
    """How `encoded(x)` changes when x changes along `dx` (..., D): its directional derivative."""
    parts = [dx]
    for k in range(num):
        angle, rate = x * 2.0**k, dx * 2.0**k
        parts += [torch.cos(angle) * rate, -torch.sin(angle) * rate]
    return torch.cat(parts, -1)
