"""Where paths point, as the file system sees it: links, and names that differ in case only."""

from __future__ import annotations

import os
from pathlib import Path


def lies_in(path: Path, folder: Path) -> bool:
    """Whether `path` is `folder` or lies below it. Compares files, not names: macOS and Windows ignore case."""
    real = path.resolve()
    there = [above for above in (real, *real.parents) if os.path.exists(above)]
    return os.path.exists(folder) and any(os.path.samefile(above, folder) for above in there)
