"""Synthetic surgical sequences with full ground truth, for the demo and for benchmarks."""

from __future__ import annotations

from .config import PhantomConfig
from .generate import write_phantom

__all__ = ["PhantomConfig", "write_phantom"]
