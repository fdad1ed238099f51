"""A kernel that adds two numbers: where it runs, Triton finds its compilers and the driver. For `torch_probe` only.

Triton keeps what it compiled in its own cache, as it does when it renders: a cache that cannot be written fails here.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl


@triton.jit
def _add(a, b, out, num, BLOCK: tl.constexpr):
    lanes = tl.arange(0, BLOCK)
    here = lanes < num
    tl.store(out + lanes, tl.load(a + lanes, mask=here) + tl.load(b + lanes, mask=here), mask=here)


def adds(device: str) -> bool:
    """Whether one and one make two there."""
    ones = torch.ones(2, device=device)
    out = torch.zeros_like(ones)
    _add[(1,)](ones, ones, out, 2, BLOCK=2)
    return out.sum().item() == 4.0
