"""Train and score one cell of a benchmark in its own process; `cell.json` marks it as finished.

`python -m endoprior.experiments.worker JOB.json`, where JOB.json holds the fields of `Job`. An interrupted cell
resumes from its checkpoint.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time as clock
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..core.checks import InputError
from ..data.files import read_json
from ..system.atomic import write_json, write_text

DONE = "cell.json"
"""Written last: a folder that has it, with the same key, is finished."""


@dataclass(frozen=True)
class Job:
    """The input of a worker."""

    name: str
    folder: str
    """Folder of the cell, absolute."""
    data: str
    """Sequence folder, absolute."""
    config: dict[str, Any]
    """Every field of `Config`."""
    key: str
    """Hash of everything that determines the result."""
    networks: bool
    weights_dir: str | None
    threads: int
    """Threads of Numba and torch."""

    def write(self, path: Path) -> None:
        """Save as JSON."""
        write_json(path, asdict(self))


def finished(folder: Path, key: str) -> bool:
    """Whether `folder` holds a finished cell with this `key` and readable scores."""
    try:
        scores = read_json(folder / "metrics.json").get("scores")
        return read_json(folder / DONE).get("key") == key and isinstance(scores, dict)
    except InputError:
        return False


def work(job: Job) -> None:
    """Train and score one cell; its run folder is `run/`, the scores are beside it.

    Raises:
        InputError: the sequence or the config cannot be used.
    """
    from ..core.config import Config
    from ..core.config_io import from_dict
    from ..data import load_sequence
    from ..evaluation.scoring import evaluate, scored_data
    from ..runs.training_run import train
    from ..training.trainer import device_for

    cfg, folder = from_dict(Config, job.config), Path(job.folder)
    run, key_file = folder / "run", folder / "key"
    same = key_file.exists() and key_file.read_text(encoding="utf-8") == job.key
    resume = (run / "checkpoint.safetensors").exists() and same
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_text(key_file, job.key)
    began = clock.perf_counter()
    scene = train(load_sequence(job.data, cfg.data), cfg, run, resume=resume)
    seconds = clock.perf_counter() - began
    sequence = load_sequence(job.data, scored_data(cfg.data))
    weights_dir = Path(job.weights_dir) if job.weights_dir else None
    scene = scene.to(device_for(cfg.render.backend))  # score on the training device
    result = evaluate(scene, sequence, networks=job.networks, weights_dir=weights_dir)
    if resume:
        result.skipped["train_seconds"] = "the run was interrupted"
    else:
        result.scores["train_seconds"] = seconds
    result.save(folder)
    (run / "checkpoint.safetensors").unlink()  # large, and no longer needed
    write_json(folder / DONE, {"name": job.name, "key": job.key, "seconds": clock.perf_counter() - began})


def main(argv: list[str]) -> int:
    """Work on the job file `argv[0]`; exit status as for the command line."""
    job = Job(**json.loads(Path(argv[0]).read_text(encoding="utf-8")))
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        work(job)
    except InputError as error:
        print(f"endoprior: {' '.join(str(error).split())}", file=sys.stderr)
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
