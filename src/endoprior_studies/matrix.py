"""The whole matrix: write phantoms and changed copies, find finished cells, run the others.

Below OUT: `sequences/` (phantoms, copies with found masks or an estimated path) and `cells/KEY/` (metrics, run
folder). A cell's folder is named by a hash of everything that determines its result, so that equal cells of different
specs run once.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from endoprior.core.checks import InputError, input_error
from endoprior.core.config_io import to_dict
from endoprior.data.reading import read_parts
from endoprior.evaluation.context import read_frame_scores, read_scores
from endoprior.evaluation.pictures import fingerprint
from endoprior.evaluation.true_masks import SCORES_FILE
from endoprior.runs.log import Growth, growth_of

from .execute import Executor
from .matched_count import Place, Search, search_thresholds
from .method import origin_of
from .spec import Cell, Spec, cells, sequence_folder
from .worker import REPEAT, CellJob, finished

if TYPE_CHECKING:
    from endoprior.data import FrameSequence

KEY_DIGITS = 16
SCORES_VERSION = 2
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
    extents: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    """Frames, width and height of each of these, as it is read."""
    waiting: dict[Cell, str] = field(default_factory=dict)
    """Folder of each cell that was only looked for; equal cells have the same one."""
    relative: set[str] = field(default_factory=set)
    """Names of those whose depth has no known scale, so that lengths are not in mm."""
    searches: dict[Place, Search] = field(default_factory=dict)
    """What was found for methods with a search for their threshold."""

    def mean_count(self, place: Place) -> float:
        """Mean number of Gaussians at the end, over the finished seeds; NaN if there are none."""
        folders = [f for cell, f in self.done.items() if (cell.sequence, cell.method, cell.budget) == place]
        counts = [growth.last for folder in folders if (growth := growth_of(folder / "run"))]
        return sum(counts) / len(counts) if counts else math.nan


def run_matrix(
    spec: Spec,
    out: Path,
    execute: Executor | None,
    *,
    threads: int = 1,
    weights_dir: Path | None = None,
    progress: Callable[[str], None] = lambda _text: None,
) -> Matrix:
    """Run every cell that is not finished yet; methods with a search for their threshold come after the others.

    Args:
        out: folder of the benchmark; its finished cells are kept if nothing that determines them has changed.
        execute: runs the jobs; None runs nothing and only finds finished cells.
        threads: of each cell.
        progress: takes a line of text.
    """
    matrix = Matrix(spec, out)
    run = _Runner(matrix, execute, threads, weights_dir, progress)
    own = [cell for cell in cells(spec) if not spec.methods[cell.method].match]
    run.report(own)
    run({cell: None for cell in own})
    if len(own) == len(cells(spec)):
        return matrix

    def train(wanted: dict[Cell, float]) -> dict[Cell, Growth | str]:
        run(dict(wanted))
        none = "no Gaussians were counted"
        return {cell: matrix.missing.pop(cell, "") or growth_of(matrix.done[cell] / "run") or none for cell in wanted}

    matrix.searches = search_thresholds(spec, matrix.mean_count, train)
    for place, search in matrix.searches.items():
        of_place = [cell for cell in cells(spec) if (cell.sequence, cell.method, cell.budget) == place]
        if search.failure:  # the threshold of a probe is not the one that was asked for
            matrix.missing |= {cell: search.failure for cell in of_place}
            matrix.done = {cell: folder for cell, folder in matrix.done.items() if cell not in of_place}
        else:
            run({cell: search.best[0] for cell in of_place})
    return matrix


class _Runner:
    """Finds finished cells and runs the others; what it learns goes to the matrix."""

    def __init__(
        self,
        matrix: Matrix,
        execute: Executor | None,
        threads: int,
        weights_dir: Path | None,
        progress: Callable[[str], None],
    ) -> None:
        """Find the sequences; phantoms and changed copies are written if anything is to run."""
        self.matrix, self.execute, self.threads, self.progress = matrix, execute, threads, progress
        self.weights_dir = str(weights_dir.absolute()) if weights_dir else None
        self.trained_on: dict[str, Path] = {}
        self.known: dict[str, list[Any]] = {}  # what determines results on a sequence
        self.unreadable: dict[str, str] = {}
        write, spec = execute is not None, matrix.spec
        for name in spec.sequences:
            try:
                sequence = open_sequence(spec, name, matrix.out, write)
                self.trained_on[name], self.known[name] = sequence.path, [sequence.fingerprint()]
                if found := spec.sequences[name].found_parts:
                    from .changed_copy import changed_copy  # late: it imports what finds tools and follows the camera

                    say = partial(self._say_of, name)
                    folder, chosen = matrix.out / "sequences", spec.sequences[name]
                    copy = changed_copy(sequence.path, chosen, folder, SCORES_VERSION, say, write=write)
                    self.trained_on[name] = copy.path
                    self.known[name] += [copy.fingerprint()]
                    if "masks" in found:
                        self.known[name].append(read_scores(copy.path / SCORES_FILE, REPEAT)["scores"])
                matrix.data[name] = sequence.path
                matrix.extents[name] = len(sequence), sequence.camera(0).width, sequence.camera(0).height
                matrix.relative |= {name} if sequence.depth_is_relative else set()
            except InputError as error:
                self.unreadable[name] = str(error)

    def _say_of(self, name: str, text: str) -> None:
        self.progress(f"{name}: {text}")

    def report(self, some: list[Cell]) -> None:
        """Say how many of some cells there are to run."""
        unread = sum(cell.sequence in self.unreadable for cell in some)
        jobs = {cell: job for cell in some if isinstance(job := self._job(cell, None), CellJob)}
        searched = len(cells(self.matrix.spec)) - len(some)
        later = f", {searched} after a search for their threshold" if searched else ""
        done = len(some) - unread - len(jobs)
        self.progress(f"{len(some)} cells: {done} done before, {len(jobs)} to run, {unread} without data{later}")
        for name, reason in self.unreadable.items():
            self.progress(f"note: {name}: {reason}")

    def __call__(self, thresholds: dict[Cell, float | None]) -> None:
        """Run cells, each with a threshold of growth or its own."""
        matrix, by_folder, jobs = self.matrix, {}, {}
        for cell, threshold in thresholds.items():
            job = self._job(cell, threshold)
            if isinstance(job, Path):
                matrix.done[cell] = job
            elif isinstance(job, str):
                matrix.missing[cell] = job
            elif self.execute is None:
                matrix.missing[cell], matrix.waiting[cell] = "not run yet", job.folder
            else:  # different methods can have equal configs
                jobs[job.folder] = job
                by_folder.setdefault(job.folder, []).append(cell)
        began, ended = clock.perf_counter(), 0
        for outcome in self.execute([*jobs.values()]) if self.execute and jobs else ():
            ended += 1
            for cell in by_folder[outcome.job.folder]:
                if outcome.failure:
                    matrix.missing[cell] = outcome.failure
                    matrix.failed += 1
                else:
                    matrix.done[cell] = Path(outcome.job.folder)
            left = (clock.perf_counter() - began) / ended * (len(by_folder) - ended)
            result = f"failed: {outcome.failure}" if outcome.failure else f"done in {outcome.seconds:.0f} s"
            self.progress(f"[{ended}/{len(by_folder)}] {outcome.job.name}: {result}; about {left / 60:.0f} min left")

    def _job(self, cell: Cell, threshold: float | None) -> CellJob | Path | str:
        """The job of a cell; its folder if it is finished, and the reason if it cannot run."""
        matrix, spec = self.matrix, self.matrix.spec
        if reason := self.unreadable.get(cell.sequence):
            return reason
        method, reading = spec.methods[cell.method].name, spec.sequences[cell.sequence].reading_of(cell.fold)
        options = to_dict(spec.config(cell.method, cell.sequence, cell.budget, cell.seed, threshold, cell.fold))
        try:
            made = _made_from(spec, cell, options)
        except InputError as error:
            return str(error)
        first, *others = self.known[cell.sequence]
        facts = [_identity(options, cell.fold), first, spec.networks, SCORES_VERSION, *made, *others]
        if spec.protocols:
            own_masks = matrix.data[cell.sequence] / "gt_masks"  # protocols may read them, methods need not
            facts.append([sorted(spec.protocols), fingerprint(own_masks) if own_masks.is_dir() else ""])
        key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
        folder = (matrix.out / "cells" / key[:KEY_DIGITS]).absolute()
        if finished(folder, key):
            return folder
        return CellJob(
            name=cell.name,
            folder=str(folder),
            data=str(self.trained_on[cell.sequence].absolute()),
            scored_on=str(matrix.data[cell.sequence].absolute()),
            found_parts=spec.sequences[cell.sequence].found_parts,
            method=method,
            options=options,
            reading=options["data"] if spec.has_config(cell.method) else reading,
            seed=cell.seed,
            key=key,
            networks=spec.networks,
            weights_dir=self.weights_dir,
            threads=self.threads,
            protocols=spec.protocols,
        )


def _identity(options: dict[str, Any], fold: int) -> dict[str, Any]:
    """The options that name a cell's folder: without the phase of the published split, and what is not fitted to the
    clip, which earlier cells lack.
    """
    if options.get("fit_to_clip") is False:
        options = {name: value for name, value in options.items() if name != "fit_to_clip"}
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
    if origin := origin_of(method.name):
        return [method.name, origin, cell.seed, spec.sequences[cell.sequence].reading_of(cell.fold)]
    return []


def open_sequence(spec: Spec, name: str, out: Path, write: bool) -> FrameSequence:
    """A sequence; a missing phantom is written.

    Raises:
        InputError: it is missing, cannot be read, or has not the number of frames of the published one.
    """
    from endoprior.core.config import DataConfig
    from endoprior.data import load_sequence
    from endoprior.phantom import write_phantom

    folder, chosen = sequence_folder(spec, name, out), spec.sequences[name]
    if unset := re.search(r"\$\{?(\w+)", str(folder)):
        raise input_error(chosen.path, f"the variable {unset[1]}", "none", f"set it, or use --data {name}=FOLDER.")
    if chosen.phantom and write and not folder.is_dir():
        write_phantom(folder, chosen.phantom)
    sequence = load_sequence(folder, DataConfig(**chosen.reading))
    published = spec.published.frames.get(name) if spec.published else None
    if published not in (None, len(sequence)):
        want, fix = f"the {published} frames of the published sequence {name}", f"Correct --data {name}=FOLDER."
        raise input_error(folder, want, f"{len(sequence)}", fix)
    return sequence


def commits_of(matrix: Matrix) -> list[str]:
    """Commits at which the finished cells of presets were trained, sorted; "unknown" outside a checkout."""
    records = [folder / "run" / "config.json" for folder in matrix.done.values()]
    parts = {"commit": str | None}
    commits = {read_parts(record, parts, REPEAT)["commit"] for record in records if record.exists()}
    return sorted(commit or "unknown" for commit in commits)


def frames_of(folder: Path) -> dict[str, dict[int, float]]:
    """Values of single test frames of a finished cell, by score and index of the frame."""
    file, found = folder / "per_frame.json", {}
    for row in read_frame_scores(file) if file.exists() else ():
        for score, value in row.items():
            if score not in ("index", "time"):
                found.setdefault(score, {})[int(row["index"])] = value
    return found


def scores_of(folder: Path) -> dict[str, Any]:
    """`scores`, `skipped` and `protocol` of a finished cell."""
    return read_scores(folder / "metrics.json")
