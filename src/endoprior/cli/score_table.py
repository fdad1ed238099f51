"""Scores as lines for people: those of an evaluation, and of the protocols of other papers beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..evaluation.context import Evaluation
from ..evaluation.protocols.table import KEYS, SCORES
from ..evaluation.registry import all_scores
from ..evaluation.score import GROUPS, Score

LINE = "  {group:<7} {label:<18} {value:>15} {arrow:1}  {hint}"
OURS = "ours"
COLUMNS = 3
"""Protocols beside ours in one block, so that lines stay near 100 characters."""
NAME, WIDTH = 18, 21


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


def protocol_table(result: Evaluation, relative: bool = False) -> list[str]:
    """The lines of the blocks: scores and tags, then what differs and why scores have no value; else nothing.

    Args:
        result: an evaluation with or without protocols.
        relative: whether the scale of the depth is unknown, so that lengths are not in mm.
    """
    lines: list[str] = []
    ours = {"scores": result.scores, "tags": result.protocol["tags"]}
    scored = [name for name, about in result.protocols.items() if about["tags"]]
    for start in range(0, len(scored), COLUMNS):
        some = {name: result.protocols[name] for name in scored[start : start + COLUMNS]}
        lines += ["", *_block({OURS: ours} | some, relative)]
    for name, about in result.protocols.items():
        published = [f"{KEYS[tag]}: {text}" for tag, text in about["paper"].items() if text != about["tags"].get(tag)]
        lines += ["", f"{name}: {about['title']} ({about['source']})", "  as published: " + "; ".join(published)]
        lines += [f"  {sentence}" for sentence in about["differs"]]
    return [*lines, *_left_out(result)]


def _left_out(result: Evaluation) -> list[str]:
    """One line for each reason and the scores that it costs, with the protocols."""
    protocols: dict[tuple[str, str], list[str]] = {}
    for name, about in result.protocols.items():
        labels: dict[str, list[str]] = {}
        for score, reason in about["skipped"].items():
            labels.setdefault(reason, []).append(SCORES[score].label)
        for reason, scores in labels.items():
            protocols.setdefault((", ".join(scores), reason), []).append(name)
    lines = [f"  not computed: {scores} ({', '.join(who)}): {why}" for (scores, why), who in protocols.items()]
    return ["", *lines] if lines else []


def _block(columns: Mapping[str, Mapping[str, Any]], relative: bool) -> list[str]:
    lines = ["protocol".ljust(NAME) + "".join(name.ljust(WIDTH) for name in columns)]
    for name, score in SCORES.items():
        values = [column["scores"].get(name) for column in columns.values()]
        if any(value is not None for value in values[1:]):
            lines.append(_line(score.heading(relative), [_number(value, score.digits) for value in values]))
    for tag, label in KEYS.items():
        lines.append(_line(label, [column["tags"].get(tag, "-") for column in columns.values()]))
    return [line.rstrip() for line in lines]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _line(label: str, values: list[str]) -> str:
    return label.ljust(NAME) + "".join(value.ljust(WIDTH - 1) + " " for value in values)
