"""The scores of other papers' protocols for people: one column each, with the tags that make it comparable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..evaluation.context import Evaluation
from ..evaluation.protocols.table import KEYS, SCORES

OURS = "ours"
COLUMNS = 3
"""Protocols beside ours in one block, so that lines stay near 100 characters."""
NAME, WIDTH = 18, 21


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
    return [*lines, *_not_computed(result)]


def _not_computed(result: Evaluation) -> list[str]:
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
