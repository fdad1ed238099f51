"""Sequences: folders in the EndoNeRF layout, read lazily, split into training and test frames.

No torch here: images are NumPy arrays.
"""

from .depth import clean_depth
from .endonerf import load_sequence
from .sequence import FrameList, Sequence, Split
from .shrink import shrunk
from .truth import Truth

__all__ = ["FrameList", "Sequence", "Split", "Truth", "clean_depth", "load_sequence", "shrunk"]
