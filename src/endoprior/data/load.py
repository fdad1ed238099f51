"""Opens a folder of any known layout."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ..core.config import DataConfig
from .endonerf import load_endonerf
from .files import entries
from .formats import FORMATS, Format
from .reading import complaint, kind_of
from .sequence import FrameSequence


def load_sequence(
    path: str | Path, cfg: DataConfig | None = None, *, pose_axes: Literal["opencv", "opengl"] = "opencv"
) -> FrameSequence:
    """Open a sequence folder; frames are decoded when they are used.

    Args:
        path: the folder.
        cfg: its layout, which frames and masks are read, and how depth is cleaned.
        pose_axes: meaning of the stored poses of the EndoNeRF layout, see `load_endonerf`.
    Raises:
        InputError: the folder is not a sequence; one line with file, expectation, finding and next step.
        ValueError: unknown `pose_axes`, or `opengl` for another layout.
    """
    if pose_axes not in ("opencv", "opengl"):
        raise ValueError(f"pose_axes must be opencv or opengl; got {pose_axes!r}")
    cfg = cfg or DataConfig()
    path = Path(path).expanduser()
    if (kind := kind_of(path)) != "a folder":
        got = "no such folder" if kind == "nothing" else kind
        raise complaint(path, "a sequence folder", got, "Pass the folder that holds images/, masks/ and depth/.")
    chosen = find_format(path, cfg)
    if pose_axes == "opencv":
        return chosen.load(path, cfg)
    if chosen.name != "endonerf":
        raise ValueError(f"pose_axes must be opencv for the {chosen.name} layout, which fixes it; got {pose_axes!r}")
    return load_endonerf(path, cfg, pose_axes=pose_axes)


def find_format(path: Path, cfg: DataConfig) -> Format:
    """The layout that `cfg.format` names, or the first that recognizes the folder.

    Raises:
        InputError: none does.
    """
    for candidate in FORMATS:
        if cfg.format == candidate.name or (cfg.format == "auto" and candidate.recognizes(path)):
            return candidate
    names = sorted(entry.name + "/" * entry.is_dir() for entry in entries(path) if not entry.name.startswith("."))
    got = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    known = ", ".join(candidate.name for candidate in FORMATS)
    raise complaint(path, f"one of the layouts {known}", got or "an empty folder", "See docs/datasets.md.")
