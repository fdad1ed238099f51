"""A run on disk: config, log, checkpoints, the finished scene. Interruption saves; resuming gives the same bits."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import threading
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from ..core.checks import InputError
from ..core.config_io import to_dict
from ..data.files import read_json
from ..data.reading import kind_of
from ..render import ON_GPU
from ..system.atomic import refuse_occupied, remove_leftovers, whole_file, write_json, writing
from ..system.devices import name_of
from ..training.divergence import Diverged
from .checkpoint import load_checkpoint, save_checkpoint
from .identity import refuse_other_run

if TYPE_CHECKING:
    from ..model.scene import Scene
    from ..training.state import StepReport
    from ..training.trainer import Trainer

LOG_EVERY = 10
"""Iterations between two lines of `log.jsonl`."""
CHECKPOINT_SECONDS = 60.0
"""Longest time of work that a crash can cost, besides the iteration in progress, unless told otherwise."""
CHECKPOINT_SHARE = 0.05
"""Of the time that writing checkpoints may take: large states are written less often."""
LOCK = ".lock"
"""File that a process holds while it trains in a folder."""
LAST_GOOD = "last_good.safetensors"
"""The scene just before its training diverged."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is kept on disk; none of it changes the result."""

    resume: bool = False
    """Continue the run in the folder."""
    checkpoint_seconds: float = CHECKPOINT_SECONDS
    """Time between two checkpoints, or more where `CHECKPOINT_SHARE` asks for it."""


def refuse_unusable_folder(out: Path, *, resume: bool) -> None:
    """Refuse a folder that cannot take a run; nothing is made yet.

    Raises:
        InputError: it is a file, or it holds something and `resume` is False, or its name is not usable.
    """
    there = kind_of(out) == "a folder"
    if there:
        remove_leftovers(out)
    if not (resume and there):
        refuse_occupied(out, ", or add --resume to continue a run", spare=LOCK)


def prepare_run_folder(out: Path, *, resume: bool) -> bool:
    """Make sure that `out` is there and can take a run.

    Returns:
        Whether the folder was made now.
    Raises:
        InputError: as `refuse_unusable_folder`, or it cannot be made.
    """
    refuse_unusable_folder(out, resume=resume)
    there = out.is_dir()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a place for a folder; got {error.strerror}. Choose another.") from error
    return not there


def train_in_folder(
    trainer: Trainer, out: Path, options: RunOptions, *, on_step: Callable[[StepReport, Trainer], None] | None
) -> Scene:
    """Run `trainer` to the end, keeping its state in `out`; see `train.train`."""
    made = prepare_run_folder(out, resume=options.resume)
    with _only_process(out):
        fingerprint = trainer.sequence.fingerprint()
        try:
            _begin(trainer, out, options.resume, fingerprint)
        except InputError:
            if made:  # nothing was begun
                shutil.rmtree(out, ignore_errors=True)
            elif not options.resume:
                (out / "config.json").unlink(missing_ok=True)
            raise
        try:
            _advance(trainer, out, options, fingerprint, on_step)
        except Diverged as error:
            save_checkpoint(trainer, out / "checkpoint.safetensors", fingerprint)
            trainer.scene().save(out / LAST_GOOD)
            state = trainer.state
            raise Diverged(
                f"{out}: {state.stage.name.lower()} iteration {state.iteration + 1}: {error}; the scene before is "
                f"{LAST_GOOD}."
            ) from error
        scene = trainer.scene()
        scene.save(out / "scene.safetensors")
    return scene


def _begin(trainer: Trainer, out: Path, resume: bool, fingerprint: str) -> None:
    """Put the trainer where the folder says, and write what must be known to repeat the run."""
    checkpoint, about = out / "checkpoint.safetensors", out / "config.json"
    if resume and checkpoint.is_file():
        load_checkpoint(trainer, checkpoint, fingerprint)
    elif resume and about.is_file():  # stopped before its first checkpoint
        stored = read_json(about)
        data = stored.get("data")
        known = data.get("fingerprint") if isinstance(data, dict) else None
        refuse_other_run(about, stored.get("config"), known, trainer.cfg, fingerprint, trainer.sequence.path)
    elif resume:
        raise InputError(f"{checkpoint}: expected a checkpoint to resume from; found none. Start without --resume.")
    write_json(about, run_facts(trainer, fingerprint))
    if trainer.state is None:
        trainer.start()
    _cut_log(out / "log.jsonl", int(trainer.state.stage), trainer.state.iteration)


def _advance(
    trainer: Trainer,
    out: Path,
    options: RunOptions,
    fingerprint: str,
    on_step: Callable[[StepReport, Trainer], None] | None,
) -> None:
    """Iterate to the end, or to a signal to stop; then, and in between, write checkpoints."""
    checkpoint, log = out / "checkpoint.safetensors", out / "log.jsonl"
    due_at = clock.monotonic() + options.checkpoint_seconds
    with writing(log), open(log, "a", buffering=1) as lines, deferred_interrupt() as interrupted:
        while not trainer.finished:
            report = trainer.step()
            if report.iteration % LOG_EVERY == 0:
                lines.write(json.dumps(_log_line(report)) + "\n")
            if on_step:
                on_step(report, trainer)
            if interrupted() or clock.monotonic() >= due_at:
                began = clock.monotonic()
                trainer.settle()
                save_checkpoint(trainer, checkpoint, fingerprint)
                taken = clock.monotonic() - began
                due_at = clock.monotonic() + max(options.checkpoint_seconds, taken / CHECKPOINT_SHARE)
            if interrupted():
                raise KeyboardInterrupt
        save_checkpoint(trainer, checkpoint, fingerprint)


@contextmanager
def _only_process(out: Path) -> Iterator[None]:
    """Hold the folder, so that no second process trains in it; a killed process lets go by itself.

    Raises:
        InputError: another process holds it.
    """
    lock = FileLock(out / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(
            f"{out}: expected a folder that no other process trains in; one does. Wait for it or choose another folder."
        ) from None
    try:
        yield
        (out / LOCK).unlink(missing_ok=True)
    finally:
        lock.release()


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold back Ctrl-C and what schedulers and closing terminals send, so that no iteration is cut in half.

    Yields a function that says whether to stop. A second Ctrl-C stops at once.
    """
    pressed = False

    def note(signum: int, frame: Any) -> None:
        nonlocal pressed
        if pressed and signum == signal.SIGINT:
            raise KeyboardInterrupt
        pressed = True

    if threading.current_thread() is not threading.main_thread():  # only the main one may handle signals
        yield lambda: False
        return
    asked = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    previous = {number: signal.getsignal(number) for number in asked}
    try:
        for number in asked:
            if number == signal.SIGINT or previous[number] is not signal.SIG_IGN:  # `nohup` means it
                signal.signal(number, note)
        yield lambda: pressed
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def run_facts(trainer: Trainer, fingerprint: str) -> dict[str, Any]:
    """What must be known to repeat the run: every config field, versions, commit, backend, and the data."""
    backend = trainer.cfg.render.backend
    names = ["endoprior", "torch", "numpy", "numba", "scipy", "opencv-python-headless"]
    names += [backend] if backend in ON_GPU else []
    return {
        "config": to_dict(trainer.cfg),
        "seed": trainer.cfg.seed,
        "backend": backend,
        "device": name_of(trainer.device),
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
