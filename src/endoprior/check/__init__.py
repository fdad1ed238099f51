"""Look at a sequence before training: what it is (facts), what is wrong with it (findings), and one picture of it.

Nothing here needs torch: pictures, masks, depth and points are NumPy arrays.
"""

from .facts import Facts, measure
from .findings import Finding, find
from .picture import draw_check

__all__ = ["Facts", "Finding", "draw_check", "find", "measure"]
