"""The player: one HTML file that plays the scene in a browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..model.scene import Scene
from .options import ExportOptions


def write(scene: Scene, out: Path, options: ExportOptions, progress: Callable[[int, int], None]) -> None:
    """Write the page; see `html.write_html`."""
    from .html import write_html

    times, max_bytes = list(options.times) or None, round(options.max_mb * 1e6)
    write_html(scene, out, title=options.title, times=times, max_bytes=max_bytes)
    progress(1, 1)
