"""Sequences: folders in the layouts of the public datasets, read lazily, split into training and test frames.

No torch here: images are NumPy arrays. What cannot be used, a file, a folder or an option, raises `InputError`, which
names it, what was expected, what was found and the fix. Only other errors, and unusual cases, are named at a function.
"""

from .images import read_depth_file
from .load import load_sequence
from .pixels import clean_depth, shrunk
from .sequence import FrameList, FrameSequence, Split, check_sequence
from .stir import nearest_end_errors, write_stir_tracks
from .truth import RightEye, Truth

__all__ = [
    "FrameList",
    "FrameSequence",
    "RightEye",
    "Split",
    "Truth",
    "check_sequence",
    "clean_depth",
    "load_sequence",
    "nearest_end_errors",
    "read_depth_file",
    "shrunk",
    "write_stir_tracks",
]
