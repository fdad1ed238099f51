"""A run on disk: config, log, checkpoints, the finished scene. Interruption saves; resuming gives the same bits."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .atomic import refuse_occupied, whole_file, write_json
from .checkpoint import load_checkpoint, save_checkpoint
from .checks import InputError
from .config_io import to_dict

if TYPE_CHECKING:
    from .model.scene import Scene
    from .train_state import StepReport
    from .trainer import Trainer

LOG_EVERY = 10
"""Iterations between two lines of `log.jsonl`."""
CHECKPOINT_SECONDS = 120.0
"""Longest time of work that a crash can cost, besides the iteration in progress."""


def prepare_run_folder(out: Path, *, resume: bool) -> None:
    """Make sure `out` can take a run.

    Raises:
        InputError: it is a file, or it holds something and `resume` is False, or it cannot be made.
    """
    if not (resume and out.is_dir()):
        refuse_occupied(out, ", or add --resume to continue a run")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a place for a folder; got {error.strerror}. Choose another.") from error


def train_in_folder(
    trainer: Trainer, out: Path, *, resume: bool, on_step: Callable[[StepReport, Trainer], None] | None
) -> Scene:
    """Run `trainer` to the end, keeping its state in `out`; see `train.train`."""
    prepare_run_folder(out, resume=resume)
    fingerprint = trainer.sequence.fingerprint()
    checkpoint, log = out / "checkpoint.safetensors", out / "log.jsonl"
    if resume:
        load_checkpoint(trainer, checkpoint, fingerprint)
        _cut_log(log, int(trainer.state.stage), trainer.state.iteration)
    else:
        trainer.start()
    write_json(out / "config.json", run_facts(trainer, fingerprint))
    saved_at = clock.monotonic()
    with open(log, "a", buffering=1) as lines, deferred_interrupt() as interrupted:
        while not trainer.finished:
            report = trainer.step()
            if report.iteration % LOG_EVERY == 0:
                lines.write(json.dumps(_log_line(report)) + "\n")
            if on_step:
                on_step(report, trainer)
            if interrupted() or clock.monotonic() - saved_at > CHECKPOINT_SECONDS:
                save_checkpoint(trainer, checkpoint, fingerprint)
                saved_at = clock.monotonic()
            if interrupted():
                raise KeyboardInterrupt
        save_checkpoint(trainer, checkpoint, fingerprint)
    scene = trainer.scene()
    scene.save(out / "scene.safetensors")
    return scene


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold back Ctrl-C, so that no iteration is cut in half; yields a function that says whether it was pressed."""
    pressed = False

    def note(signum: int, frame: Any) -> None:
        nonlocal pressed
        pressed = True

    try:
        previous = signal.signal(signal.SIGINT, note)
    except ValueError:  # not in the main thread, where signals cannot be handled
        yield lambda: False
        return
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, previous)


def run_facts(trainer: Trainer, fingerprint: str) -> dict[str, Any]:
    """What must be known to repeat the run: every config field, versions, commit, backend, and the data."""
    names = ("endoprior", "torch", "numpy", "numba", "scipy", "opencv-python-headless")
    return {
        "config": to_dict(trainer.cfg),
        "seed": trainer.cfg.seed,
        "backend": trainer.cfg.render.backend,
        "commit": source_commit(),
        "versions": {name: version(name) for name in names} | {"python": sys.version.split()[0]},
        "data": {
            "path": str(trainer.sequence.path.resolve()),
            "fingerprint": fingerprint,
            "frames": len(trainer.sequence),
        },
    }


def source_commit() -> str | None:
    """Commit of the checkout this package runs from, with `+` if files differ from it; None outside a checkout."""
    here = Path(__file__).parent
    try:
        commit = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            cwd=here,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        # An installed package can lie inside somebody else's checkout: only a tracked file speaks for its repository.
        subprocess.run(
            ["git", "ls-files", "--error-unmatch", __file__], cwd=here, capture_output=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return commit.stdout.strip()


def _log_line(report: StepReport) -> dict[str, Any]:
    line = {"stage": report.stage.name.lower(), "iteration": report.iteration, "num_gaussians": report.num_gaussians}
    return line | {"terms": report.terms, "seconds": round(report.seconds, 4)}


def _cut_log(log: Path, stage: int, iteration: int) -> None:
    """Drop the lines of iterations after the checkpoint: they will be written again."""
    if not log.exists():
        return
    order = ["coarse", "fine"]
    kept = []
    for text in log.read_text().splitlines():
        try:
            line = json.loads(text)
            done = (order.index(line["stage"]), line["iteration"]) <= (stage, iteration)
        except (ValueError, KeyError):  # a line that a crash cut short
            continue
        if done:
            kept.append(text + "\n")
    with whole_file(log) as temporary:
        temporary.write_text("".join(kept))
