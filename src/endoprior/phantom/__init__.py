"""Synthetic surgical sequences with full ground truth, for the demo and for benchmarks."""

from __future__ import annotations

from ..core.callable_package import make_callable
from .config import PhantomConfig
from .generate import write_phantom

__all__ = ["PhantomConfig", "write_phantom"]

make_callable(__name__, write_phantom)
