"""Every score. To add one, write a module in `scorers/` and name it in `SCORERS`; see docs/scores.md.

Other packages add scorers as plugins (docs/plugins.md).
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, cast

from ..system.plugins import Registry, report
from .score import Score

if TYPE_CHECKING:
    from .context import EvaluationContext

SCORERS = (
    "image",
    "depth",
    "motion",
    "lpips",
    "other_views",
    "highlights",
    "tracks",
    "deformation",
    "ranges",
    "camera_path",
    "references",
    "model",
)
"""Modules of `scorers/`, in the order in which they run. Each has `SCORES` and `compute(context)`."""


class Scorer(Protocol):
    """Computes some scores; usually a module."""

    SCORES: tuple[Score, ...]

    def compute(self, context: EvaluationContext) -> None:
        """Record every score, or why it has no value; ScoreUnavailable is the reason of each without one."""
        ...


def _problem(found: Any) -> str:
    scores = getattr(found, "SCORES", None)
    if not isinstance(scores, tuple) or not scores or not all(isinstance(score, Score) for score in scores):
        return f"SCORES of type {type(scores).__name__}"
    if not callable(getattr(found, "compute", None)):
        return "no function compute"
    again = [score.name for score in scores if score.name in _builtin_scores()]
    return f"another score {again[0]}, which is built in" if again else ""


def _builtin(name: str) -> Scorer:
    return cast(Scorer, import_module(f".scorers.{name}", __package__))  # a module as an instance of the protocol


REGISTRY: Registry[Scorer] = Registry(
    "scores",
    "SCORES, a tuple of endoprior.evaluation.score.Score, and compute(context)",
    _problem,
    modules=SCORERS,
    load_module=_builtin,
)
"""The scorers above, and those of plugins."""


def scorers() -> dict[str, Scorer]:
    """The scorers by name: those of `SCORERS`, then plugins. Of two plugins with one score, the second is left out."""
    known, taken = {name: _builtin(name) for name in SCORERS}, set()
    for name, scorer in REGISTRY.usable():
        if again := sorted(taken & {score.name for score in scorer.SCORES}):
            report(f"{name} of {REGISTRY.origin(name)} is left out: another plugin has the score {again[0]}")
        else:
            known[name] = scorer
            taken |= {score.name for score in scorer.SCORES}
    return known


@cache
def all_scores() -> dict[str, Score]:
    """Every score by name: those of scenes, those of tool masks, which need no scene, and those of plugins."""
    return _builtin_scores() | {score.name: score for scorer in scorers().values() for score in scorer.SCORES}


def _builtin_scores() -> dict[str, Score]:
    of_masks = import_module(".true_masks", __package__).SCORES
    return {
        score.name: score for scores in (*(_builtin(name).SCORES for name in SCORERS), of_masks) for score in scores
    }
