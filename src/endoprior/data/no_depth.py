"""Reader of what `endoprior prepare --depth none` leaves: the EndoNeRF layout without `depth/`, to add depth to."""

from __future__ import annotations

from pathlib import Path

from .formats import Format
from .plain import load_plain


def is_without_depth(path: Path) -> bool:
    """Whether a prepared folder has poses and no depth; that of others may have depth under another name."""
    written = all((path / name).is_file() for name in ("poses_bounds.npy", "sequence.json"))
    return written and (path / "images").is_dir() and not (path / "depth").exists()


FORMAT = Format(is_without_depth, load_plain)
