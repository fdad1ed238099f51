"""How many threads a process computes with."""

from __future__ import annotations

from dataclasses import dataclass


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
        import torch

        numba.set_num_threads(min(self.numba, numba.config.NUMBA_NUM_THREADS))
        torch.set_num_threads(self.torch)
