"""Train and score one cell of a benchmark in its own process; `cell.json` marks it as finished.

`python -m endoprior_studies.worker JOB.json`, where JOB.json holds the fields of `CellJob`. An interrupted cell
resumes from its checkpoint.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time as clock
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from endoprior.core.checks import InputError
from endoprior.data.description import read_description
from endoprior.data.reading import read_own, read_parts
from endoprior.system.atomic import write_json, write_text
from endoprior.system.console import complain

REPEAT = "remove it, and repeat the command."
DONE = "cell.json"
"""Written last: a folder that has it, with the same key, is finished."""
FOUND = "methods train with masks found from the footage; scores of these masks: all frames, full size, against masks/"
"""Protocol of cells on sequences with `masks: found`."""
ESTIMATED = "methods train with a camera path estimated from the footage; path scores: against the sequence's own poses"
"""Protocol of cells on sequences with `poses: estimated`."""


@dataclass(frozen=True)
class CellJob:
    """The input of a worker."""

    name: str
    folder: str
    """Folder of the cell, absolute."""
    data: str
    """Sequence folder to train on, absolute."""
    scored_on: str
    """Sequence folder to score on: `data`, or with `found_parts` the one that has the true ones."""
    found_parts: dict[str, str]
    """See `SequenceSpec.found_parts`."""
    method: str
    """Name in the registry of methods."""
    options: dict[str, Any]
    """Every option of the method."""
    reading: dict[str, Any]
    """Fields of `DataConfig`: how the method reads the sequence."""
    seed: int
    key: str
    """Hash of everything that determines the result."""
    networks: bool
    weights_dir: str | None
    threads: int
    """Threads of Numba and torch."""
    protocols: tuple[str, ...] = ()
    """Also score as these papers did."""

    def write(self, path: Path) -> None:
        """Save as JSON."""
        write_json(path, asdict(self))


def finished(folder: Path, key: str) -> bool:
    """Whether `folder` holds a finished cell with this `key` and readable scores."""
    from endoprior.evaluation.context import read_scores

    try:
        read_scores(folder / "metrics.json")
        return read_parts(folder / DONE, {"key": str, "seconds": float}, REPEAT)["key"] == key
    except InputError:
        return False


def work(job: CellJob) -> None:
    """Train and score one cell; its run folder is `run/`, the scores are beside it.

    Raises:
        InputError: the sequence or the config cannot be used.
    """
    from endoprior.core.config import DataConfig
    from endoprior.core.config_io import from_dict
    from endoprior.core.geometry import camera_to_world
    from endoprior.data import load_sequence
    from endoprior.evaluation.context import read_scores
    from endoprior.evaluation.scoring import evaluate, scored_data
    from endoprior.evaluation.true_masks import SCORES_FILE
    from endoprior.model.scene import RenderedScene
    from endoprior.runs.log import growth_of

    from .method import PICTURES, method_named, origin_of

    method, folder = method_named(job.method), Path(job.folder)
    options, reading = from_dict(type(method.options), job.options), from_dict(DataConfig, job.reading)
    run, key_file = folder / "run", folder / "key"
    resume = run.is_dir() and key_file.exists() and key_file.read_text(encoding="utf-8") == job.key
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_text(key_file, job.key)
    began = clock.perf_counter()
    found = method.train(load_sequence(job.data, reading).training_view(), options, seed=job.seed, out=run)
    seconds = clock.perf_counter() - began
    sequence = load_sequence(job.scored_on, scored_data(reading))
    weights_dir = Path(job.weights_dir) if job.weights_dir else None
    given_path = camera_to_world(map(sequence.camera, range(len(sequence)))) if "poses" in job.found_parts else None
    networks = {"networks": job.networks, "download": True, "weights_dir": weights_dir}
    asked = {"reading": reading, "given_path": given_path, "protocols": job.protocols}
    result = evaluate(found, sequence, **networks, **asked)
    if "poses" in job.found_parts:
        source = read_description(Path(job.data) / "sequence.json").get("sources", {}).get("poses", "unknown")
        result.protocol["poses: estimated"] = f"{ESTIMATED}; found: {source}"
    if "masks" in job.found_parts:
        of_masks = read_scores(Path(job.data) / SCORES_FILE, REPEAT)
        result.scores |= of_masks["scores"]
        result.skipped |= of_masks["skipped"]
        result.protocol["masks: found"] = FOUND
    if job.method == PICTURES:
        result.skipped["train_seconds"] = "the images come from another program"
    elif resume:
        result.skipped["train_seconds"] = "the run was interrupted"
    else:
        result.scores["train_seconds"] = seconds
    if growth := growth_of(run):
        result.scores["gaussians_growth"] = growth.ratio
    if origin := origin_of(job.method):
        about = {"name": job.method, "package": origin, "options": job.options, "seed": job.seed}
        result.provenance["plugin"] = about
    if isinstance(found, RenderedScene) and not (run / "scene.safetensors").exists():
        found.save(run / "scene.safetensors")
    result.save(folder)
    (run / "checkpoint.safetensors").unlink(missing_ok=True)  # large, and no longer needed
    write_json(folder / DONE, {"name": job.name, "key": job.key, "seconds": clock.perf_counter() - began})


def main(argv: list[str]) -> int:
    """Work on the job file `argv[0]`; exit status as for the command line."""
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        work(read_own(Path(argv[0]), CellJob, REPEAT))
    except InputError as error:
        complain(f"endoprior: {' '.join(str(error).split())}")
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _end_with(parent: int) -> None:
    """End this process when `parent` ends, because its result would be lost."""
    while os.getppid() == parent:
        clock.sleep(0.5)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
