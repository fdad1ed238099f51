"""A synthetic operation with full ground truth: the demo's data and the benchmark that knows the answer."""

from __future__ import annotations

from .config import PhantomConfig
from .generate import write_phantom

__all__ = ["PhantomConfig", "write_phantom"]
