"""Find surgical tools in the frames of one clip, without a trained network: the clip itself is the training data."""

from .model import FoundTools, ToolModel, ToolSample, fit_tools

__all__ = ["FoundTools", "ToolModel", "ToolSample", "fit_tools"]
