"""Devices and threads that compute."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def num_cores() -> int:
    """The cores that this process may use: `taskset` and schedulers of clusters leave it some of the machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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


@dataclass(frozen=True)
class Threads:
    """Threads of the two libraries that compute."""

    numba: int
    """Cores to use. The kernels give the same bits for any number."""
    torch: int
    """Equal for all processes of one run: vectorized functions of torch round differently with another number."""

    @classmethod
    def of_this_process(cls) -> Threads:
        """Those that this process computes with."""
        import numba
        import torch

        return cls(numba.get_num_threads(), torch.get_num_threads())

    def use(self) -> None:
        """Compute with these from now on; Numba with no more than it started with."""
        import numba
        import numba.core.config
        import torch

        started_with: int = getattr(numba.core.config, "NUMBA_NUM_THREADS")  # noqa: B009  # set by a function of Numba
        numba.set_num_threads(min(self.numba, started_with))
        torch.set_num_threads(self.torch)
