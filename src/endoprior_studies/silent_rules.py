"""Rules of density control that never did anything: what a table says of them is an artifact."""

from __future__ import annotations

from collections import Counter

from endoprior.runs.log import growth_of

from .matrix import Matrix


def silent_rules(matrix: Matrix) -> list[str]:
    """A line for each method and sequence with a rule that no Gaussian ever met, over all seeds and budgets."""
    spec, lines = matrix.spec, []
    for sequence in spec.sequences:
        for method in spec.methods:
            folders = [f for cell, f in matrix.done.items() if (cell.sequence, cell.method) == (sequence, method)]
            grown = [growth for folder in folders if (growth := growth_of(folder / "run"))]
            if not grown:
                continue
            events, changes = sum(growth.num_events for growth in grown), Counter[str]()
            for growth in grown:
                changes.update(growth.changes)
            if silent := _silent(changes):
                lines.append(f"{spec.label(method)}, {sequence}: {silent} in {events} density events")
    return lines


def _silent(changes: Counter[str]) -> str:
    """What never happened, in words; empty if everything did."""
    if not changes:
        return "nothing grew or went"
    rules = [
        name.removeprefix("removed_") for name, count in changes.items() if name.startswith("removed_") and not count
    ]
    words = [] if changes["cloned"] + changes["split"] else ["nothing grew"]
    words += [f"the rule {rule} removed nothing" for rule in rules]
    return ", ".join(words)
