"""Scores as lines for people: name, value with unit, which way is better, and what is good."""

from __future__ import annotations

from collections.abc import Mapping

from ..evaluation.registry import all_scores
from ..evaluation.score import GROUPS, Score

LINE = "  {group:<7} {label:<18} {value:>15} {arrow:1}  {hint}"


def score_table(scores: Mapping[str, float], skipped: Mapping[str, str], relative: bool = False) -> list[str]:
    """The lines of the table, at most 29 and as many as there are reasons for skipped scores.

    Args:
        scores: value by name.
        skipped: reason by name, of scores that could not be computed.
        relative: whether the scale of the depth is unknown, so that lengths are not in mm.
    """
    lines = []
    for group in GROUPS:
        title = group
        for score in _summary(scores):
            if score.group == group:
                value = score.text(scores[score.name], relative)
                hint = _references(score, scores) or score.hint
                line = LINE.format(group=title, label=score.label, value=value, arrow=score.arrow, hint=hint)
                lines.append(line.rstrip())
                title = ""
    if relative and any(score.is_length for score in _summary(scores)):
        lines.append("  rel.: the scale of the depth is unknown. Compare these scores on this sequence only.")
    return [*lines, *_not_computed(skipped)]


def _summary(names: Mapping[str, object]) -> list[Score]:
    return [score for name, score in all_scores().items() if name in names and score.in_summary]


def _references(score: Score, scores: Mapping[str, float]) -> str:
    """What chained optical flow and no motion score, for scores of tracks; what a warp does, for the right eye."""
    if (warp := scores.get(f"{score.name}_warp")) is not None:
        return f"left eye moved by depth {warp:,.{score.digits}f}"
    if f"{score.name}_still" not in scores:
        return ""
    known = {what: scores.get(f"{score.name}_{end}") for end, what in (("dis", "chained flow"), ("still", "no motion"))}
    return ", ".join(f"{what} {value:,.{score.digits}f}" for what, value in known.items() if value is not None)


def _not_computed(skipped: Mapping[str, str]) -> list[str]:
    """One line for each reason: scores that need the same missing package stand together."""
    labels: dict[str, list[str]] = {}
    for score in _summary(skipped):
        labels.setdefault(skipped[score.name], []).append(score.label)
    return [f"  not computed: {', '.join(names)}: {reason}" for reason, names in labels.items()]
