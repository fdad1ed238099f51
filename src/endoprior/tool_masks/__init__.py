"""Find surgical tools in the frames of a clip, with a small network that comes with the program."""

from ..data.found_tools import FoundTools
from .tool_finder import ToolFinder

__all__ = ["FoundTools", "ToolFinder"]
