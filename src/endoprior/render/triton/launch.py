"""Launching a kernel on the device of its tensors."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
import triton


def launch(kernel: triton.JITFunction, programs: int, *arguments: Any, **options: Any) -> None:
    """Run that many programs of a kernel; 0 launches nothing.

    Triton takes the current device, which need not be that of the tensors: the first argument's counts.
    """
    device = arguments[0].device
    with torch.cuda.device(device) if device.type == "cuda" else nullcontext():
        kernel[(programs,)](*arguments, **options)
