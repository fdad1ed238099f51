"""What the kernels share: their launch on the device of its tensors, and access to three neighboring numbers."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
import triton
import triton.language as tl


def launch(kernel: triton.JITFunction, programs: int, *arguments: Any, **options: Any) -> None:
    """Run that many programs of a kernel; 0 launches nothing.

    Triton takes the current device, which need not be that of the tensors: the first argument's counts.
    """
    device = arguments[0].device
    with torch.cuda.device(device) if device.type == "cuda" else nullcontext():
        kernel[(programs,)](*arguments, **options)


@triton.jit
def load_three(place, mask):
    """The numbers at place, place + 1 and place + 2; 0 outside `mask`."""
    return tl.load(place, mask, 0.0), tl.load(place + 1, mask, 0.0), tl.load(place + 2, mask, 0.0)


@triton.jit
def store_three(place, a, b, c, mask):
    """Write to place, place + 1 and place + 2."""
    tl.store(place, a, mask)
    tl.store(place + 1, b, mask)
    tl.store(place + 2, c, mask)
