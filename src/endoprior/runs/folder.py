"""The run folder: who may write to it, `config.json`, which says what run it holds, and the checkpoint to resume it."""

from __future__ import annotations

import shutil
import signal
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from torch import Tensor

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..core.config_io import to_dict
from ..core.shell import command
from ..data import FrameSequence
from ..data.reading import kind_of, load_yaml, read_json, read_text
from ..model.hexplane import TOUCHED
from ..model.method import config_from, method_of
from ..model.windowed_scene import window_file
from ..render import ON_GPU
from ..system.arrays_file import ArraySpec, load_arrays, load_facts, rejecting, save_arrays
from ..system.atomic import is_leftover, reject_occupied, remove_leftovers, write_json
from ..system.devices import name_of
from ..system.file_lock import locked
from ..system.installation import source_commit
from ..system.signals import handled_by
from ..training.trainer import Observer, Stage, StepReport, Trainer, device_for, stage_length

LOCK = ".lock"  # file that a process holds while it trains in a folder
CONFIG, LOG, CHECKPOINT, SCENE = "config.json", "log.jsonl", "checkpoint.safetensors", "scene.safetensors"
CHECKPOINT_SECONDS = 60.0
"""Longest time of work that a crash can cost, besides the iteration in progress, unless told otherwise."""
CHECKPOINT_SHARE = 0.05  # share of the time that writing checkpoints may take: large states are written less often
CHECKPOINT_FORMAT = "endoprior-checkpoint-1"
RESTART = "Train again without --resume."


def reject_unusable_folder(out: Path, *, resume: bool) -> None:
    """Raise InputError where `out` is a file, or holds something without `resume`; nothing is created yet."""
    exists = kind_of(out) == "a folder"
    if not (resume and exists):
        is_run = exists and (out / CONFIG).is_file()
        resume_it = f", or resume the run in it: `{command('train', '--resume', out)}`" if is_run else ""
        reject_occupied(out, resume_it, ignore=lambda file: file.name == LOCK or is_leftover(file))


def prepare_run_folder(out: Path, *, resume: bool) -> None:
    """Make sure that `out` exists and can take a run; raise InputError if it cannot."""
    reject_unusable_folder(out, resume=resume)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a place for a folder, got {error.strerror}. Fix: Choose another.") from error


@contextmanager
def held_folder(out: Path, *, resume: bool, begin: Callable[[], None]) -> Iterator[None]:
    """Hold a run folder, which no other process can use meanwhile, after `begin` has begun the run in it.

    Raises:
        InputError: the folder cannot take the run; where the run did not begin, one that was created is removed.
    """
    existed, began = out.is_dir(), False
    prepare_run_folder(out, resume=resume)
    try:
        with locked(out, out / LOCK):
            begin()
            began = True
            yield
    except InputError:
        if not (began or existed):
            shutil.rmtree(out, ignore_errors=True)
        elif not (began or resume):
            (out / CONFIG).unlink(missing_ok=True)
        raise


def record_run(
    out: Path,
    sequence: FrameSequence,
    cfg: Config,
    fingerprint: str,
    *,
    resume: bool,
    any_length: bool = False,
    **facts: Any,
) -> None:
    """Write `config.json`: all that is needed to repeat the run, and `facts`.

    Raises:
        InputError: the run to `resume` has another config or other data (`reject_other_run`); or the data changed while
            they were read.
    """
    about, backend = out / CONFIG, cfg.render.backend
    sequence.demand_unchanged()  # what was read before is of the same state
    if resume:
        stored = read_json(about, "start without --resume.", "a run to resume")
        known = _data_facts(stored).get("fingerprint")
        reject_other_run(about, stored.get("config"), known, cfg, fingerprint, sequence.path, any_length=any_length)
    remove_leftovers(out)  # not before the run was accepted and has the lock
    names = ["endoprior", "torch", "numpy", "numba", "scipy", "opencv-python-headless"]
    names += [backend] if backend in ON_GPU else []
    about_run = {
        "config": to_dict(cfg),
        "seed": cfg.seed,
        "backend": backend,
        "device": name_of(device_for(backend)),
        "commit": source_commit(),
        "versions": {name: version(name) for name in names} | {"python": sys.version.split()[0]},
        "data": {"path": str(sequence.path.resolve()), "fingerprint": fingerprint, "frames": len(sequence)},
    }
    write_json(about, about_run | facts)


def reject_other_run(
    file: Path,
    stored_config: Any,
    stored_fingerprint: Any,
    cfg: Config,
    fingerprint: str,
    data: Path,
    *,
    any_length: bool = False,
) -> None:
    """Raise InputError where the stored config, naming all fields, or the stored data differ from the current ones.

    Args:
        any_length: accept what `Config.extended` changes: the extension was checked before (`reject_unextendable`).
    """
    stored = config_of(stored_config, file)
    if any_length:
        schedule = replace(stored.schedule, fine_iterations=cfg.schedule.fine_iterations)
        density = replace(stored.density, stop_iteration=cfg.density.stop_iteration)
        stored = replace(stored, schedule=schedule, density=density)
    _reject_other_config(file, stored, cfg)
    if stored_fingerprint != fingerprint:
        raise InputError(f"{file}: was trained on other data than {data}. Fix: Pass the same sequence.")


def _reject_other_config(file: Path, stored: Config, cfg: Config) -> None:
    if changed := ", ".join(_differences(to_dict(stored), to_dict(cfg))):
        fix = f"`{command('train', '--resume', file.parent)}` takes the options of the folder"
        raise InputError(f"{file}: config differs at {changed}. Fix: {fix}; a new run needs a new folder.")


def reject_unextendable(run: Path, cfg: Config, num_frames: int) -> None:
    """Raise InputError unless `cfg` makes the run longer, or a stopped one shorter, and changes nothing else."""
    if not method_of(cfg).has_gaussians:
        want = "a run of a method with Gaussians: rates of the others fall over the whole length"
        raise input_error("--iterations", want, cfg.method, "remove it.")
    file, wanted = run / CONFIG, cfg.schedule.total
    stored = read_json(file, "pass the folder of a run.")
    former = config_of(stored.get("config"), file)
    fitted = (method_of(cfg).fitted(some, num_frames) for some in (former.extended(wanted), cfg))
    _reject_other_config(file, *fitted)
    windows = stored.get("windows")
    parts = [window_file(run / SCENE, k).parent for k in range(len(windows))] if isinstance(windows, list) else [run]
    done = [_iterations_done(part / CHECKPOINT, former) for part in parts]
    if wanted < max(done) or wanted <= min(done):
        want = f"more than the {max(done):,} of {former.schedule.total:,} iterations that {run} has done"
        raise input_error("--iterations", want, f"{wanted:,}", "choose more.")


def _iterations_done(checkpoint: Path, cfg: Config) -> int:
    """Iterations of both stages that a checkpoint holds; 0 without one."""
    if not checkpoint.is_file():
        return 0
    with rejecting(checkpoint, "a training state", RESTART):
        about = load_facts(checkpoint, CHECKPOINT_FORMAT, RESTART)
        return int(about["iteration"]) + (cfg.schedule.coarse_iterations if Stage(about["stage"]) is Stage.FINE else 0)


def remove_results(run: Path) -> None:
    """Remove the scene of a run and its scores, before it is extended: a run with a scene counts as done."""
    for pattern in (SCENE, "metrics*.json", "per_frame*.json"):
        for file in run.glob(pattern):
            file.unlink()


def _differences(old: dict[str, Any], new: dict[str, Any], where: str = "") -> Iterator[str]:
    """Each field that differs, with both values."""
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(old[name], dict):
            yield from _differences(old[name], value, f"{where}{name}.")
        elif value != old[name]:
            yield f"{where}{name} ({old[name]!s:.80} in the folder, {value!s:.80} now)"


def _data_facts(stored: dict[str, Any]) -> dict[str, Any]:
    facts = stored.get("data")
    return facts if isinstance(facts, dict) else {}


def config_of_run(run: Path) -> Config:
    """The config that a run was started with, from its `config.json`."""
    file = run / CONFIG
    return config_of(read_json(file, "pass the folder of a run that was interrupted.").get("config"), file)


def sequence_of_run(run: Path, hint: str = "pass --data FOLDER.") -> Path:
    """The sequence folder that a run was trained on, from its `config.json`; `hint` is the fix of the error message."""
    path = _data_facts(read_json(run / CONFIG, hint)).get("path")
    if not isinstance(path, str) or not path:
        raise input_error(run / CONFIG, "the path of the sequence", repr(path), hint)
    data = Path(path)
    if kind_of(data) != "a folder":
        raise input_error(data, "the sequence this run was trained on", "no such folder", hint)
    return data


def read_config(file: Path, base: Config) -> Config:
    """The config in a file: `config.json` of a run, or YAML or JSON with some fields; `base` gives the others."""
    fix = "pass config.json of a run, or a YAML file with fields of the config."
    if file.suffix.lower() == ".json":
        values = read_json(file, fix)
    else:
        try:
            values = load_yaml(read_text(file, "a config", fix))
        except yaml.YAMLError as error:
            raise input_error(file, "YAML", " ".join(str(error).split())[:120], fix) from None
    if isinstance(values, dict) and "config" in values:  # a run's file, which also names versions and data
        values = values["config"]
    if not isinstance(values, dict):
        raise input_error(file, "named fields of the config", type(values).__name__, fix)
    return config_of(_merged(to_dict(base), values), file)


def config_of(values: Any, file: Path) -> Config:
    """The config that was read from `file`, named in the InputError; fields that it lacks get their default."""
    try:
        return config_from(values)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` with the entries of `changes`; dicts in both are merged."""
    both = {key for key in changes if isinstance(base.get(key), dict) and isinstance(changes[key], dict)}
    return base | {key: _merged(base[key], value) if key in both else value for key, value in changes.items()}


def checkpoint_writer(path: Path, fingerprint: str, seconds: float, interrupted: Callable[[], bool]) -> Observer:
    """Writes a checkpoint every `seconds`, and when `interrupted` says so; it then raises KeyboardInterrupt."""
    due_at = clock.monotonic() + seconds

    def observer(_report: StepReport, trainer: Trainer) -> None:
        nonlocal due_at
        stop, began = interrupted(), clock.monotonic()
        if stop or began >= due_at:
            trainer.synchronize()
            save_checkpoint(trainer, path, fingerprint)
            now = clock.monotonic()
            due_at = now + max(seconds, (now - began) / CHECKPOINT_SHARE)
        if stop:
            raise KeyboardInterrupt

    return observer


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold back Ctrl-C and the signals of schedulers and closing terminals until an iteration is complete.

    Yields a function that says whether to stop. A second Ctrl-C stops at once.
    """
    pressed = False

    def note(signum: int, _frame: Any) -> None:
        nonlocal pressed
        if pressed and signum == signal.SIGINT:
            raise KeyboardInterrupt
        pressed = True

    with handled_by(note):
        yield lambda: pressed


def save_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Write everything that the next iteration depends on, and the fingerprint of the sequence.

    Raises:
        InputError: the data changed meanwhile; the checkpoint before is kept, which no changed frame went into.
    """
    trainer.sequence.demand_unchanged(fingerprint)
    state = trainer.state
    about = {"stage": int(state.stage), "iteration": state.iteration, "config": to_dict(trainer.cfg)}
    save_arrays(path, state.arrays(), about | {"fingerprint": fingerprint}, CHECKPOINT_FORMAT)


def load_checkpoint(trainer: Trainer, path: Path, fingerprint: str, *, any_length: bool = False) -> None:
    """Restore the saved state in `trainer`; `any_length`: see `reject_other_run`.

    Raises:
        InputError: the file is missing or damaged, or belongs to another config or other data.
    """
    cfg, sequence, next_step = trainer.cfg, trainer.sequence, RESTART

    def schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
        stored = (about["config"], about["fingerprint"])
        reject_other_run(path, *stored, cfg, fingerprint, sequence.path, any_length=any_length)
        return trainer.schema()

    arrays, about = load_arrays(path, {CHECKPOINT_FORMAT: schema}, next_step)
    with rejecting(path, "a training state", next_step):
        stage, iteration = Stage(about["stage"]), about["iteration"]
        length = stage_length(cfg, stage)
        if type(iteration) is not int or not 0 <= iteration <= length:
            raise InputError(
                f"expected 0 to {length} as iteration of the {stage.name.lower()} stage; got {iteration!r:.80}."
            )
        before = stage_length(cfg, Stage.COARSE) if stage is Stage.FINE else 0  # a method may keep its optimizer
        check_state(arrays, before + iteration)
        num_frames = len(sequence.indices("train"))
        for name, spec in trainer.schema().items():
            if "F" in spec.shape and (got := arrays[name].shape[spec.shape.index("F")]) != num_frames:
                raise InputError(f"expected {num_frames} training frames in {name}; got {got}.")
    trainer.restore(stage, iteration, arrays)


def check_state(arrays: Mapping[str, Tensor], iterations: int) -> None:
    """Raise InputError for an array, finite and of the right shape, that no training of so many iterations produces."""
    for name, value in arrays.items():
        low, high, expected = 0.0, float("inf"), "no negative number"
        if name.endswith(".steps"):
            high, expected = iterations, f"0 to {iterations} steps"
        elif name == "left_out":
            high, expected = 1, "shares"
        elif name == "tracks.rows":
            high = arrays["tracks.displacement"].shape[1] - 1
            expected = f"rows up to {high}"
        elif name.endswith(".marks"):
            touched = len(arrays["optimizer.plane_adam.exp_avg"])
            high, expected = TOUCHED if int(value.count_nonzero()) == touched else -1.0, f"{touched} touched cells"
        elif not name.startswith("stats.") and not name.endswith((".second", ".exp_avg_sq")):
            low = -high
        if not bool(((value >= low) & (value <= high)).all()):
            raise InputError(f"expected {expected} in {name}; got something else.")
