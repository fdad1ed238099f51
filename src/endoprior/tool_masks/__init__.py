"""Find surgical tools in the frames of a clip, with a small network that comes with the program."""

from .finder import FoundTools, ToolFinder

__all__ = ["FoundTools", "ToolFinder"]
