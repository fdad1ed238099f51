"""Who does the arithmetic: Numba's kernels on the CPU; on any other device the definitions that they agree with.

Every kernel has a definition in a few lines of torch, which says what it computes and runs wherever torch does. Nothing
else in the program asks where a tensor lies.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

_definitions_everywhere = False


def compiled(tensor: Tensor) -> bool:
    """Whether kernels take this tensor."""
    return tensor.device.type == "cpu" and not _definitions_everywhere


@contextmanager
def definitions_only() -> Iterator[None]:
    """Run the definitions on the CPU as well: how they are tested without another device."""
    global _definitions_everywhere
    before, _definitions_everywhere = _definitions_everywhere, True
    try:
        yield
    finally:
        _definitions_everywhere = before
