"""The name of a device, and waiting for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def name_of(device: torch.device) -> str:
    """What computes there, in words: the GPU's name, or how many threads of the CPU."""
    if device.type == "cuda":
        import torch

        return torch.cuda.get_device_name(device)
    import numba

    return f"CPU, {numba.get_num_threads()} threads"


def wait_for(device: torch.device) -> None:
    """Return when all that was queued there is done; on the CPU it is."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)
