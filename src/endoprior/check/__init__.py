"""Check a sequence before training: measure it (facts), list its problems (findings), draw a figure.

NumPy only, no torch.
"""

from .facts import Facts, measure
from .figure import draw_check
from .findings import Finding, find

__all__ = ["Facts", "Finding", "draw_check", "find", "measure"]
