"""The name of a device, and waiting for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def name_of(device: torch.device) -> str:
    """The name of the GPU, or "CPU, N threads"."""
    if device.type == "cuda":
        import torch

        return torch.cuda.get_device_name(device)
    import numba

    return f"CPU, {numba.get_num_threads()} threads"


def wait_for(device: torch.device) -> None:
    """Wait until a device has finished its work; the CPU always has."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)
