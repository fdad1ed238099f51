"""One HTML file that plays a scene in a browser: no server, no network, nothing to install.

The page holds the Gaussians of every time step as deflated integers (`html_data`), window by window, unpacks a window
when it is needed, and renders them with WebGL 2 by the
formulas of our renderer (`player/`). Its content security policy forbids it to load or send anything.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import InputError, input_error
from ..core.geometry import length_unit
from ..model.scene import Scene
from ..system.atomic import whole_file
from .formats import Format, Progress
from .html_data import CHANNELS, Block, pack, quantized_blocks
from .options import ExportOptions


class PageTooLarge(InputError):
    """The page would exceed the limit."""

    def __init__(self, message: str, num_bytes: int) -> None:
        super().__init__(message)
        self.num_bytes = num_bytes
        """Size of the page; where packing stopped before its end, what it would be if all went on like that."""


DATA_FORMAT = "endoprior-player-2"
"""Name and version of the data in the page."""
NOTHING_VISIBLE = "scene: expected Gaussians in front of the camera, got none that is visible. Fix: Train it again."
DEFAULT_TITLE = "EndoPrior-GS scene"
DEFLATE_LEVEL = 6
"""zlib level: 9 saves 2 % and takes three times as long."""
PLAYER = Path(__file__).parent / "player"
SCRIPTS = ("aside.js", "unpack.js", "blocks.js", "sort.js", "camera.js", "shaders.js", "draw.js", "player.js")


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the page; see `write_html`."""
    times, max_bytes = list(options.times) or None, round(options.max_mb * 1e6)
    write_html(scene, out, title=options.title, times=times, max_bytes=max_bytes)
    progress(1, 1)


def write_html(
    scene: Scene, out: Path, *, title: str = "", times: list[float] | None = None, max_bytes: int = 20_000_000
) -> Path:
    """Write a single-file player of `scene`: a web page that opens from disk and needs nothing else.

    It renders the Gaussians at `times`, from the cameras of the sequence or from a free view. Rounding (`html_data`)
    moves centers by at most 0.05 mm and an eighth of a pixel per axis at the working distance of a window, rotations by
    half a degree, scales by 1 %, opacities by 0.0005, colors by half of an 8-bit level. Colors are always those seen
    from the sequence's camera at that time. A page that would be too large is an error: nothing is left out or rounded
    further.

    Args:
        out: file to write; an existing one is replaced, and missing folders are created.
        title: at the top of the page and in the browser's tab.
        times: T times in [0, 1], increasing; None: those of the frames.
        max_bytes: largest size of the file.
    Returns:
        `out`.
    Raises:
        InputError: `out` is a folder, `times` is empty or not increasing, no Gaussian is visible, or the page would
            exceed `max_bytes` (`PageTooLarge`).
        ValueError: a time is not in [0, 1].
    """
    out = Path(out)
    if out.is_dir():
        raise input_error(out, "a file to write", "a folder", f"add a name such as {out / 'scene.html'}.")
    if times is None:
        times = [i / len(scene.cameras) for i in range(len(scene.cameras))]
    if not times or any(b <= a for a, b in pairwise(times)):
        raise input_error("times", "one or more increasing times", f"{times}", "list each time once.")
    blocks, streams, num_shown, focus = [], [], np.zeros(len(times), int), {}
    near, far = math.inf, 0.0
    for block in quantized_blocks(scene, times):
        data, channels = pack(block.values, DEFLATE_LEVEL)
        blocks.append(_about_block(block, channels))
        streams.append(data)
        num_shown[block.steps] += block.values.shape[2]
        focus[(block.steps.start + block.steps.stop - 1) / 2] = block.focus
        near, far = min(near, block.depth_range[0]), max(far, block.depth_range[1])
        size = _base64_length(sum(map(len, streams)))
        if size > max_bytes:
            raise _too_large(out, max_bytes, size * len(times) / block.steps.stop, len(times), num_shown.max())
    if not blocks:
        raise InputError(NOTHING_VISIBLE)
    about = _about(scene, times) | {
        "gaussians": int(num_shown.max()),
        "focus": np.interp(range(len(times)), list(focus), list(focus.values())).round(3).tolist(),
        "depth_range": [near, far],
        "channels": CHANNELS,
        "blocks": blocks,
    }
    unit = length_unit(scene.lengths_are_relative)
    page = _page(title or DEFAULT_TITLE, unit, about, b"".join(streams)).encode()
    if len(page) > max_bytes:
        raise _too_large(out, max_bytes, len(page), len(times), num_shown.max())
    with whole_file(out) as temporary:
        temporary.write_bytes(page)
    return out


def _base64_length(num_bytes: int) -> int:
    return 4 * math.ceil(num_bytes / 3)


def _too_large(out: Path, max_bytes: int, num_bytes: float, num_times: int, num_gaussians: int) -> PageTooLarge:
    got = f"about {num_bytes / 1e6:.1f} MB for {num_times} time steps of {num_gaussians} Gaussians"
    fix = "choose fewer with --times (the size grows with their number), or raise --max-mb."
    error = input_error(out, f"at most {max_bytes / 1e6:.1f} MB", got, fix)
    return PageTooLarge(str(error), math.ceil(num_bytes))


def _about_block(block: Block, coded: list[dict[str, int]]) -> dict[str, Any]:
    """The description of a block; `channels` in the order of their streams."""
    scaled = zip(block.low.tolist(), block.step.tolist(), coded, strict=True)
    return {
        "first": block.first,
        "steps": len(block.steps),
        "gaussians": block.values.shape[2],
        "channels": [{"low": low, "step": step, **stream} for low, step, stream in scaled],
    }


def _about(scene: Scene, times: list[float]) -> dict[str, Any]:
    """What the page knows of the sequence, for JSON."""
    cameras = [scene.camera_at(time) for time in times]
    rows = [[c.fx, c.fy, c.cx, c.cy, *c.world_to_camera.ravel().tolist()] for c in cameras]
    if np.ptp(rows, axis=0).max() == 0:
        rows = rows[:1]
    return {
        "format": DATA_FORMAT,
        "width": cameras[0].width,
        "height": cameras[0].height,
        "cameras": rows,
        "background": list(scene.background),
        "seconds": [time * len(scene.cameras) / scene.frames_per_second for time in times],
    }


def _page(title: str, unit: str, about: dict[str, Any], data: bytes) -> str:
    script = "\n".join((PLAYER / name).read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "TITLE": html.escape(title),
        "STYLE": (PLAYER / "player.css").read_text(encoding="utf-8"),
        "UNIT": unit,
        "ABOUT": json.dumps(about, allow_nan=False).replace("<", "\\u003c"),
        "DATA": base64.b64encode(data).decode(),
        "SCRIPT": script,
    }
    template = (PLAYER / "player.html").read_text(encoding="utf-8")
    return re.sub(r"@@([A-Z]+)@@", lambda match: parts[match[1]], template)


FORMAT = Format(suffixes=(".html",), options=("times", "title", "max_mb"), write=write, holds="a player")
