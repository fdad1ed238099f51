"""Where the config of `train` starts from: a preset, then a file, or the run that is resumed; options override it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import get_args

from ..core.checks import input_error
from ..core.config import Config
from ..core.shell import command
from ..model.presets import PresetName, preset
from .devices import Wanted


def start_config(argv: Sequence[str]) -> tuple[PresetName, Config]:
    """The preset that the arguments name, and its config with the fields of `--config FILE`.

    It is known before the arguments are parsed, so that --help shows its values and options override them.

    Raises:
        InputError: no such preset, or the file cannot be used.
    """
    name = typed(argv, "--preset") or "default"
    if name not in get_args(PresetName):
        raise input_error("--preset", f"one of {', '.join(get_args(PresetName))}", repr(name), "`--preset default`.")
    if (file := typed(argv, "--config")) is None:
        return name, preset(name)
    from ..runs.folder import read_config

    return name, read_config(Path(file), preset(name))


def run_to_resume(data: Path, out: Path | None, argv: Sequence[str]) -> tuple[Path, Path, Config | None]:
    """What `train --resume RUN` and `train DATA RUN --resume` resume.

    Args:
        data, out: the positional arguments as parsed; `out` is None if there is only one, the run folder.
    Returns:
        Sequence folder, run folder and the run's config; None if the arguments name another config to start from. They
        must then repeat all options of the run.
    Raises:
        InputError: `config.json` of the run cannot be used, or its sequence does not exist any more.
    """
    from ..runs.folder import config_of_run, sequence_of_run

    run = out or data
    # With both folders given, a run can be resumed that lost its config.json.
    is_known = out is None or (run / "config.json").is_file()
    is_named = typed(argv, "--preset") is not None or typed(argv, "--config") is not None
    cfg = config_of_run(run) if is_known and not is_named else None
    if out is None:
        moved = f"`{command('train', 'DATA', run, '--resume')}` with the folder of the sequence."
        data = sequence_of_run(run, moved)
    return data, run, cfg


def device_to_resume(cfg: Config) -> Wanted:
    """The device of the backend that a run was started with."""
    from ..render import ON_GPU

    return "cuda" if cfg.render.backend in ON_GPU else "cpu"


def resume_command(
    run: Path, networks: bool, weights_dir: Path | None, checkpoint_seconds: float, ray: str | None = None
) -> str:
    """The command that resumes an interrupted training; config and data are those of the run folder."""
    words: list[str | Path] = [] if networks else ["--no-networks"]
    if weights_dir:
        words += ["--weights-dir", weights_dir]
    if checkpoint_seconds != 60:
        words += ["--checkpoint-seconds", f"{checkpoint_seconds:g}"]
    words += ["--ray", ray] if ray else []
    return command("train", "--resume", run, *words)


def typed(argv: Sequence[str], option: str) -> str | None:
    """The value of an option in the arguments, the last one if there are several; None without it."""
    value = None
    for word, following in zip_longest(argv, argv[1:]):
        if word == option and following is not None:
            value = following
        elif word.startswith(f"{option}="):
            value = word.partition("=")[2]
    return value
