"""Open a folder of any known layout, or say what else lies there and which command makes use of it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from ..core.checks import InputError, input_error, number_ranges, or_did_you_mean, read_ranges
from ..core.config import DataConfig
from ..core.shell import command, quoted
from .endonerf import load_endonerf
from .files import entries, or_neighbor
from .formats import REGISTRY, needs_depth, recognizing
from .image_folders import (
    beside,
    contents_of,
    image_folders,
    is_footage,
    ways_to_prepare,
)
from .reading import kind_of, read_json
from .sequence import FrameSequence
from .video_files import VIDEO_SUFFIXES, is_video

ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".7z", ".rar")
CALIBRATIONS = (".ini", ".yaml", ".yml", ".npz")
RUN_FILES = ("scene.safetensors", "checkpoint.safetensors", "log.jsonl")
WINDOWS = "windows"  # folder of a run in windows, which has none of these files before its last window is trained
SIDE = re.compile(r"(?<![a-z])(left|right|l|r)(?![a-z])", re.IGNORECASE)
"""The word of a name that tells the left camera from the right one."""


def load_sequence(
    path: str | Path, cfg: DataConfig | None = None, *, pose_axes: Literal["opencv", "opengl"] = "opencv"
) -> FrameSequence:
    """Open a sequence folder; frames are decoded when they are used.

    Args:
        path: the folder.
        cfg: its layout, which frames and masks are read, and how depth is cleaned.
        pose_axes: axes of the stored poses of the EndoNeRF layout, see `load_endonerf`.
    Raises:
        InputError: the folder is not a sequence; the message names the file, what is expected, what is there and a fix.
        ValueError: unknown `pose_axes`, or `opengl` for another layout.

    Example:
        >>> import endoprior
        >>> sequence = endoprior.load_sequence("DATA")
        >>> sequence
        FrameSequence('DATA': 10 frames (8 train, 2 test), 64x48, 15 frames per second, depth in mm)
        >>> sequence[0].rgb.shape, len(sequence.frames("test"))
        ((48, 64, 3), 2)
    """
    if pose_axes not in ("opencv", "opengl"):
        raise ValueError(f"pose_axes must be opencv or opengl; got {pose_axes!r}")
    cfg = cfg or DataConfig()
    path = Path(path).expanduser()
    if (kind := kind_of(path)) != "a folder":
        if error := not_a_sequence(path):
            raise error
        got = "no such folder" if kind == "nothing" else kind
        fix = "pass the folder that holds images/, masks/ and depth/."
        raise input_error(path, "a sequence folder", got, or_neighbor(fix, path) if kind == "nothing" else fix)
    name = find_format(path, cfg)
    if pose_axes == "opencv":
        sequence = REGISTRY.load(name).load(path, cfg)
    elif name == "endonerf":
        sequence = load_endonerf(path, cfg, pose_axes=pose_axes)
    else:
        raise ValueError(f"pose_axes must be opencv for the {name} layout, which defines it; got {pose_axes!r}")
    # Which frames are used and held out is decided here, so that readers of other packages cannot differ.
    sequence = sequence.with_test_phase(cfg.test_phase)
    if cfg.window:
        frames = sorted(read_ranges("data.window", cfg.window))
        if len(frames) < 2 or frames[-1] >= len(sequence) or frames[-1] - frames[0] != len(frames) - 1:
            expected = f"two frames within 0 to {len(sequence) - 1}, such as 0-{len(sequence) // 2}"
            raise input_error("data.window", expected, cfg.window, "correct it, or leave it out for all frames.")
        sequence = sequence.part(frames[0], frames[-1] + 1)
    _use_reliability(sequence, cfg)
    sequence.layout, sequence.reading = name, cfg
    sequence.read_again = partial(load_sequence, path, pose_axes=pose_axes)
    return sequence


def _use_reliability(sequence: FrameSequence, cfg: DataConfig) -> None:
    """Leave out frames of weight 0, unless nothing would be left to train on, or the config says otherwise."""
    weights = sequence.frame_weights
    if cfg.reliability == "ignored":
        sequence.frame_weights = None
        return
    sequence.frame_weights = np.ones(len(sequence)) if weights is None else weights
    if not (left_out := sequence.left_out):
        return
    which = f"{len(left_out)} of {len(sequence)} frames have no camera pose, or show another scene"
    if len(sequence.indices("train")) < 2:
        sequence.frame_weights = np.ones(len(sequence))
        sequence.remarks.append(f"{sequence.path}: {which}; all are used, because nothing would be left")
    else:
        frames = number_ranges(left_out)
        sequence.remarks.append(f"{sequence.path}: {which}, and are neither trained on nor scored: {frames}")


def find_format(path: Path, cfg: DataConfig) -> str:
    """The name of a layout that `cfg.format` gives; for `auto` the first layout that recognizes the folder."""
    known = ", ".join(REGISTRY.names())
    if cfg.format != "auto":
        if cfg.format in REGISTRY.names():
            return cfg.format
        fix = or_did_you_mean("see docs/datasets.md.", cfg.format, REGISTRY.names())
        raise input_error("data.format", f"one of auto, {known}", repr(cfg.format), fix)
    if name := recognizing(path):
        return name
    if error := not_a_sequence(path):
        raise error
    names = sorted(entry.name + "/" * entry.is_dir() for entry in entries(path) if not entry.name.startswith("."))
    got = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    raise input_error(path, f"one of the layouts {known}", got or "an empty folder", "see docs/datasets.md.")


def is_sequence(folder: Path) -> bool:
    """Whether a folder has one of the layouts of docs/datasets.md."""
    try:
        return recognizing(folder) is not None
    except OSError:  # not readable
        return False


def is_prepared(folder: Path) -> bool:
    """Whether a folder is a sequence that can be trained on as it is; images without depth are to be prepared."""
    return is_sequence(folder) and not needs_depth(folder)


def is_input(path: Path) -> bool:
    """Whether a model can be made of a path: a video, footage, or a sequence folder; results of ours are none."""
    if kind_of(path) == "a folder":
        return not (is_run(path) or is_run(path / "run")) and (is_sequence(path) or is_footage(path))
    return kind_of(path) == "a file" and is_video(path)


def is_run(folder: Path) -> bool:
    """Whether `train` wrote a folder."""
    return (folder / "config.json").is_file() and any((folder / name).exists() for name in (*RUN_FILES, WINDOWS))


def not_a_sequence(path: Path) -> InputError | None:
    """The error for a path that is no sequence folder but can be used otherwise; None if nothing is recognized."""
    kind = kind_of(path)
    found = None
    if kind == "a folder":
        found = what_is_in(path)
    elif kind == "a file" and path.suffix.lower() in ARCHIVES:
        found = "an archive", "unpack it and pass the folder."
    elif kind == "a file" and path.name in RUN_FILES:
        found = "a file of a run", f"`{command('view', path.parent)}`, or pass the sequence folder of the run."
    elif kind == "a file" and is_video(path):
        found = "a video", f"{ways_to_prepare(path)}."
    return input_error(path, "a sequence folder", *found) if found else None


def not_trainable(path: Path) -> InputError | None:
    """The error for footage that is to be prepared first, and what else leads to a sequence folder; None for others."""
    if is_sequence(path) and needs_depth(path):
        return input_error(path, "a sequence folder", "images without depth", f"{ways_to_prepare(path)}.")
    return None if is_sequence(path) else not_a_sequence(path)


def not_to_prepare(path: Path) -> InputError | None:
    """The error for a sequence folder that can be trained on, where `prepare` expects footage; None for others."""
    found = contents_of(path)
    if found is None or found.images == path or not is_prepared(path):
        return None
    again = command(
        "prepare", found.images, "OUT", *(word for masks in found.mask_folders[:1] for word in ("--masks", masks))
    )
    fix = f"`{command('train', path, 'RUN')}`; to prepare its images again: `{again}`."
    return input_error(path, "a video, or images without depth and poses", "a sequence folder", fix)


def not_a_run(path: Path) -> InputError | None:
    """The error for a path that is no run folder but holds one or leads to one; None for others."""
    kind = kind_of(path)
    what = fix = ""
    if kind == "nothing":
        what = f"no such {'file' if path.name == RUN_FILES[0] else 'folder'}"
        fix = or_neighbor(f"Correct the path, or make a run: `{command('train', 'DATA', path)}`.", path)
    elif kind == "a folder" and is_prepared(path):
        what, fix = "a sequence folder", f"`{command('train', path, 'RUN')}`, then pass RUN."
    elif kind == "a folder" and is_run(path / "run"):
        what, fix = "a folder with a run in it", f"pass {quoted(path / 'run')}."
    elif (kind == "a file" and is_video(path)) or (kind == "a folder" and not is_run(path) and contents_of(path)):
        what, out = "a video" if kind == "a file" else "a folder of images", beside(path, "out")
        fix = f"`{command('run', path, out)}`, then pass {quoted(out / 'run')}."
    return input_error(path, "a run folder", what, fix) if what else None


def what_is_in(path: Path) -> tuple[str, str] | None:
    """What a folder is that is no sequence, and the fix; None if it is not recognized."""
    if is_run(path):
        return "a run folder", _fix_of_run(path)
    parent = Path(os.path.abspath(path)).parent
    if is_sequence(parent):
        return "a part of a sequence folder", f"pass {quoted(parent)}."
    inside = sorted(entry for entry in entries(path) if not entry.name.startswith("."))
    folders = [entry for entry in inside if entry.is_dir()]
    sequences = [folder for folder in folders if is_sequence(folder)]
    if len(sequences) == 1:
        fix = f"pass {quoted(sequences[0])}"
        if is_run(path / "run"):
            return "a folder with a sequence and a run in it", f"{fix}; the run is {quoted(path / 'run')}."
        return "a folder with one sequence folder in it", f"{fix}."
    videos = [entry for entry in inside if entry.suffix.lower() in VIDEO_SUFFIXES and entry.is_file()]
    lenses = [entry for entry in inside if entry.suffix.lower() in CALIBRATIONS]
    lenses += [entry for entry in inside if entry.suffix == ".json" and "calib" in entry.name.lower()]
    if len(videos) == 1:
        lens = ["--calibration", lenses[0]] if len(lenses) == 1 else []
        return "a folder with a video", f"{ways_to_prepare(videos[0], *lens)}."
    for what, paths in (("videos", videos), ("image folders", image_folders(path))):
        if pair := _pair(paths):
            calibration = lenses[0] if len(lenses) == 1 else "FILE"
            fix = ways_to_prepare(pair[0], "--right", pair[1], "--calibration", calibration)
            return f"{what} of two cameras", f"{fix}."
    return ("a folder of images", f"{ways_to_prepare(path)}.") if not sequences and is_footage(path) else None


def _fix_of_run(path: Path) -> str:
    is_done = (path / "scene.safetensors").is_file()
    use = command("view", path) if is_done else command("train", "--resume", path)
    data = None
    with suppress(InputError):  # a damaged file: the run can still be named
        data = read_json(path / "config.json").get("data")
    place = data.get("path") if isinstance(data, dict) else None
    sequence = f"pass its sequence, {quoted(place)}" if isinstance(place, str) and place else "pass a sequence folder"
    return f"`{use}` {'shows' if is_done else 'resumes'} the run; else {sequence}."


def _pair(paths: Sequence[Path]) -> tuple[Path, Path] | None:
    """(left, right) if there are two paths whose names differ in that word only."""
    sides = {words[0][0].lower(): path for path in paths if len(words := SIDE.findall(path.stem)) == 1}
    if len(paths) != 2 or set(sides) != {"l", "r"} or len({SIDE.sub("", path.stem) for path in paths}) != 1:
        return None
    return sides["l"], sides["r"]
