"""Open a folder of any known layout."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ..core.checks import input_error, read_ranges
from ..core.config import DataConfig
from .endonerf import load_endonerf
from .files import entries
from .formats import REGISTRY, recognizing
from .reading import kind_of
from .recognize import not_a_sequence
from .sequence import FrameSequence


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
    """
    if pose_axes not in ("opencv", "opengl"):
        raise ValueError(f"pose_axes must be opencv or opengl; got {pose_axes!r}")
    cfg = cfg or DataConfig()
    path = Path(path).expanduser()
    if (kind := kind_of(path)) != "a folder":
        if error := not_a_sequence(path):
            raise error
        got = "no such folder" if kind == "nothing" else kind
        raise input_error(path, "a sequence folder", got, "pass the folder that holds images/, masks/ and depth/.")
    name = find_format(path, cfg)
    if pose_axes == "opencv":
        return _as_asked(REGISTRY.load(name).load(path, cfg), cfg)
    if name != "endonerf":
        raise ValueError(f"pose_axes must be opencv for the {name} layout, which defines it; got {pose_axes!r}")
    return _as_asked(load_endonerf(path, cfg, pose_axes=pose_axes), cfg)


def _as_asked(sequence: FrameSequence, cfg: DataConfig) -> FrameSequence:
    """The frames to use, and which of them are held out; here, so that readers of other packages cannot differ."""
    chosen = _window_of(sequence.with_test_phase(cfg.test_phase), cfg.window)
    chosen.reading = cfg
    return chosen


def _window_of(sequence: FrameSequence, window: str) -> FrameSequence:
    """The frames of `sequence` that `DataConfig.window` names; all of them if it names none."""
    if not window:
        return sequence
    frames = sorted(read_ranges("data.window", window))
    if len(frames) > 1 and frames[-1] < len(sequence) and frames[-1] - frames[0] == len(frames) - 1:
        return sequence.part(frames[0], frames[-1] + 1)
    expected = f"two frames within 0 to {len(sequence) - 1}, such as 0-{len(sequence) // 2}"
    raise input_error("data.window", expected, window, "correct it, or leave it out for all frames.")


def find_format(path: Path, cfg: DataConfig) -> str:
    """The name of a layout that `cfg.format` gives; for `auto` the first layout that recognizes the folder.

    Raises:
        InputError: there is no layout of that name, or none recognizes the folder.
    """
    if cfg.format != "auto":
        if cfg.format in REGISTRY.names():
            return cfg.format
        choices = f"auto, {', '.join(REGISTRY.names())}"
        raise input_error("data.format", f"one of {choices}", repr(cfg.format), "see docs/datasets.md.")
    if name := recognizing(path):
        return name
    if error := not_a_sequence(path):
        raise error
    names = sorted(entry.name + "/" * entry.is_dir() for entry in entries(path) if not entry.name.startswith("."))
    got = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    known = ", ".join(REGISTRY.names())
    raise input_error(path, f"one of the layouts {known}", got or "an empty folder", "see docs/datasets.md.")
