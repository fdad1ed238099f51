"""Every score. To add one, write a module in `scorers/` and name it in `SCORERS`; see docs/scores.md."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import ModuleType

from .score import Score

SCORERS = (
    "image",
    "depth",
    "flow",
    "lpips",
    "stability",
    "primitives",
    "behind_tool",
    "tracks",
    "speed",
)
"""Modules of `scorers/`, in the order in which they run. Each has `SCORES` and `compute(context)`."""


def scorers() -> list[ModuleType]:
    """The modules that `SCORERS` names."""
    return [import_module(f".scorers.{name}", __package__) for name in SCORERS]


@cache
def all_scores() -> dict[str, Score]:
    """Every score by name."""
    return {score.name: score for scorer in scorers() for score in scorer.SCORES}
