"""Tables of a benchmark under the protocols of other papers: one for each protocol and sequence, never two in one."""

from __future__ import annotations

from typing import Any

from endoprior.evaluation.protocols.table import KEYS, PROTOCOLS, SCORES

from .matrix import Matrix, scores_of
from .results import Results
from .spec import Cell
from .tables import Table, markdown, score_table


def protocol_tables(matrix: Matrix) -> list[Table]:
    """A table for each protocol and sequence that has a score."""
    return [table for name in matrix.spec.protocols for table in _tables(matrix, name).values()]


def protocol_blocks(matrix: Matrix, mark: str) -> list[str]:
    """The blocks of `results.md`: for each protocol what it is, its tags on each sequence, and its tables."""
    blocks: list[str] = []
    for name in matrix.spec.protocols:
        about, tables = PROTOCOLS.load(name), _tables(matrix, name)
        published = "; ".join(f"{KEYS[tag]}: {text}" for tag, text in about.paper)
        blocks.append(f"{mark} Protocol {name}")
        blocks.append(f"As {about.title} is scored ({about.source}). As published: {published}.")
        blocks += ["\n".join(f"- {sentence}" for sentence in about.differs)] if about.differs else []
        for sequence in matrix.data:
            cells = [_stored(matrix, cell, name) for cell in matrix.done if cell.sequence == sequence]
            for tags in dict.fromkeys(_tags(cell) for cell in cells if cell["tags"]):
                blocks.append(f"{sequence}, scored here: {tags}.")
            if sequence in tables:
                blocks.append(markdown(tables[sequence]))
            if skipped := dict.fromkeys(SCORES[score].label for cell in cells for score in cell["skipped"]):
                blocks.append(f"Not computed on {sequence}: {', '.join(skipped)}; `results.json` has the reasons.")
    return blocks


def protocol_values(matrix: Matrix) -> list[tuple[Any, ...]]:
    """Rows for `results.csv`; the score is named `endonerf/psnr`."""
    return [
        (cell.sequence, cell.method, cell.budget or "", cell.seed, cell.fold, f"{name}/{score}", repr(value))
        for name in matrix.spec.protocols
        for cell, scores in Results.of(matrix, name).scores.items()
        for score, value in scores.items()
    ]


def _tables(matrix: Matrix, name: str) -> dict[str, Table]:
    results = Results.of(matrix, name)
    tables = {sequence: score_table(results, sequence, SCORES, f"{sequence}, {name}") for sequence in matrix.data}
    return {sequence: table for sequence, table in tables.items() if table.columns}


def _stored(matrix: Matrix, cell: Cell, name: str) -> dict[str, Any]:
    return scores_of(matrix.done[cell])["protocols"][name]


def _tags(cell: dict[str, Any]) -> str:
    return "; ".join(f"{KEYS[tag]}: {text}" for tag, text in cell["tags"].items())
