"""The whole matrix: write phantoms and changed copies, find finished cells, run the others.

Below OUT: `sequences/` (phantoms, copies with found masks or an estimated path) and `cells/KEY/` (metrics, run
folder). A cell's folder is named by a hash of everything that determines its result, so that equal cells of different
specs run once.
"""

from __future__ import annotations

import hashlib
import json
import re
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.checks import InputError, input_error
from ..core.config_io import to_dict
from ..data.files import read_json
from ..evaluation.pictures import fingerprint
from ..evaluation.true_masks import SCORES_FILE
from .execute import Executor
from .method import REGISTRY
from .spec import Cell, Spec, cells, sequence_folder
from .worker import Job, finished

if TYPE_CHECKING:
    from ..data import FrameSequence

KEY_DIGITS = 16
SCORES_VERSION = 1
"""Increase it when a score changes its meaning; finished cells then run again."""


@dataclass
class Matrix:
    """The cells of a spec, their folders, and why some have no result."""

    spec: Spec
    out: Path
    done: dict[Cell, Path] = field(default_factory=dict)
    """Folder of each finished cell."""
    missing: dict[Cell, str] = field(default_factory=dict)
    """Why a cell has no result."""
    failed: int = 0
    """Number of cells among them that ran and failed."""
    data: dict[str, Path] = field(default_factory=dict)
    """Folder of each readable sequence that its cells are scored on."""
    relative: set[str] = field(default_factory=set)
    """Names of those whose depth has no known scale, so that lengths are not in mm."""


def run_matrix(
    spec: Spec,
    out: Path,
    execute: Executor | None,
    *,
    threads: int = 1,
    weights_dir: Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Matrix:
    """Run every cell that is not finished yet.

    Args:
        out: folder of the benchmark; its finished cells are kept if nothing that determines them has changed.
        execute: runs the jobs; None runs nothing and only finds finished cells.
        threads: of each cell.
        progress: takes a line of text.
    """
    matrix = Matrix(spec, out)
    jobs = _jobs(matrix, threads, weights_dir, progress, write=execute is not None)
    total = len(cells(spec))
    progress(f"{total} cells: {len(matrix.done)} done before, {len(jobs)} to run, {len(matrix.missing)} without data")
    for name, reason in {cell.sequence: reason for cell, reason in matrix.missing.items()}.items():
        progress(f"note: {name}: {reason}")
    if execute is None:
        matrix.missing |= {cell: "not run yet" for cell in jobs}
        return matrix
    by_folder: dict[str, list[Cell]] = {}  # different methods can have equal configs
    for cell, job in jobs.items():
        by_folder.setdefault(job.folder, []).append(cell)
    began, ended = clock.perf_counter(), 0
    for outcome in execute([jobs[same[0]] for same in by_folder.values()]):
        ended += 1
        for cell in by_folder[outcome.job.folder]:
            if outcome.failure:
                matrix.missing[cell] = outcome.failure
                matrix.failed += 1
            else:
                matrix.done[cell] = Path(outcome.job.folder)
        left = (clock.perf_counter() - began) / ended * (len(by_folder) - ended)
        result = f"failed: {outcome.failure}" if outcome.failure else f"done in {outcome.seconds:.0f} s"
        progress(f"[{ended}/{len(by_folder)}] {outcome.job.name}: {result}; about {left / 60:.0f} min left")
    return matrix


def _jobs(
    matrix: Matrix, threads: int, weights_dir: Path | None, progress: Callable[[str], None], write: bool
) -> dict[Cell, Job]:
    """A job for each cell that is not finished; fills `done`, `missing`, `data` and `relative` of the matrix."""
    spec, jobs = matrix.spec, {}
    trained_on: dict[str, Path] = {}
    known: dict[str, list[Any]] = {}  # what determines results on a sequence
    for name in spec.sequences:
        try:
            sequence = _sequence(spec, name, matrix.out, write)
            trained_on[name], known[name] = sequence.path, [sequence.fingerprint()]
            if found := spec.sequences[name].found_parts:
                copy = _changed_copy(spec, name, sequence.path, matrix.out, progress, write)
                trained_on[name] = copy.path
                known[name] += [copy.fingerprint()]
                known[name] += [read_json(copy.path / SCORES_FILE)["scores"]] if "masks" in found else []
            matrix.data[name] = sequence.path
            matrix.relative |= {name} if sequence.depth_is_relative else set()
        except InputError as error:
            matrix.missing |= {cell: str(error) for cell in cells(spec) if cell.sequence == name}
    for cell in cells(spec):
        if cell in matrix.missing:
            continue
        method, reading = spec.methods[cell.method].name, spec.sequences[cell.sequence].reading_of(cell.fold)
        options = to_dict(spec.config(cell.method, cell.sequence, cell.budget, cell.seed, cell.fold))
        try:
            made = _made_from(spec, cell, options)
        except InputError as error:
            matrix.missing[cell] = str(error)
            continue
        first, *others = known[cell.sequence]
        facts = [_identity(options, cell.fold), first, spec.networks, SCORES_VERSION, *made, *others]
        if spec.protocols:
            own_masks = matrix.data[cell.sequence] / "gt_masks"  # protocols may read them, methods need not
            facts.append([sorted(spec.protocols), fingerprint(own_masks) if own_masks.is_dir() else ""])
        key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
        folder = (matrix.out / "cells" / key[:KEY_DIGITS]).absolute()
        if finished(folder, key):
            matrix.done[cell] = folder
            continue
        jobs[cell] = Job(
            name=cell.name,
            folder=str(folder),
            data=str(trained_on[cell.sequence].absolute()),
            scored_on=str(matrix.data[cell.sequence].absolute()),
            found_parts=spec.sequences[cell.sequence].found_parts,
            method=method,
            options=options,
            reading=options["data"] if spec.has_config(cell.method) else reading,
            seed=cell.seed,
            key=key,
            networks=spec.networks,
            weights_dir=str(weights_dir.absolute()) if weights_dir else None,
            threads=threads,
            protocols=spec.protocols,
        )
    return jobs


def _identity(options: dict[str, Any], fold: int) -> dict[str, Any]:
    """The options that name a cell's folder: without the phase of the published split, which earlier cells lack."""
    data = options.get("data")
    if fold or not isinstance(data, dict):
        return options
    return options | {"data": {name: value for name, value in data.items() if name != "test_phase"}}


def _made_from(spec: Spec, cell: Cell, options: dict[str, Any]) -> list[Any]:
    """What determines the result of a cell beside its options and its sequence; nothing for presets.

    Raises:
        InputError: there are no images of the sequence.
    """
    method = spec.methods[cell.method]
    if method.pictures:
        if not options["folder"]:
            raise input_error(f"methods.{cell.method}.pictures", cell.sequence, "no entry", "name the folder.")
        folders = [Path(options[key]) for key in ("folder", "depth_folder") if options[key]]
        return [method.name, *map(fingerprint, folders), spec.sequences[cell.sequence].reading_of(cell.fold)]
    if origin := REGISTRY.origin(method.name):
        return [method.name, origin, cell.seed, spec.sequences[cell.sequence].reading_of(cell.fold)]
    return []


def _sequence(spec: Spec, name: str, out: Path, write: bool) -> FrameSequence:
    """A sequence; a missing phantom is written.

    Raises:
        InputError: it is missing or cannot be read.
    """
    from ..core.config import DataConfig
    from ..data import load_sequence
    from ..phantom import write_phantom

    folder, chosen = sequence_folder(spec, name, out), spec.sequences[name]
    if unset := re.search(r"\$\{?(\w+)", str(folder)):
        raise input_error(chosen.path, f"the variable {unset[1]}", "none", f"set it, or use --data {name}=FOLDER.")
    if chosen.phantom and write and not folder.is_dir():
        write_phantom(folder, chosen.phantom)
    return load_sequence(folder, DataConfig(**chosen.reading))


def _changed_copy(
    spec: Spec, name: str, folder: Path, out: Path, progress: Callable[[str], None], write: bool
) -> FrameSequence:
    """See `changed_copy`, which is imported late: it needs what finds tools and follows the camera."""
    from .changed_copy import changed_copy

    def say(text: str) -> None:
        progress(f"{name}: {text}")

    return changed_copy(folder, spec.sequences[name], out / "sequences", SCORES_VERSION, say, write=write)


def commits_of(matrix: Matrix) -> list[str]:
    """Commits at which the finished cells of presets were trained, sorted; "unknown" outside a checkout."""
    records = [folder / "run" / "config.json" for folder in matrix.done.values()]
    commits = {read_json(record).get("commit") for record in records if record.exists()}
    return sorted(commit or "unknown" for commit in commits)


def frames_of(folder: Path) -> dict[str, dict[int, float]]:
    """Values of single test frames of a finished cell, by score and index of the frame."""
    file, found = folder / "per_frame.json", {}
    for row in json.loads(file.read_text(encoding="utf-8")) if file.exists() else []:
        for score, value in row.items():
            if score not in ("index", "time"):
                found.setdefault(score, {})[row["index"]] = value
    return found


def scores_of(folder: Path) -> dict[str, Any]:
    """`scores`, `skipped` and `protocol` of a finished cell."""
    return read_json(folder / "metrics.json")
