"""One HTML file that plays a scene in a browser: no server, no network, nothing to install.

The page holds the Gaussians of every moment as deflated integers (`html_data`), and draws them with WebGL 2 by the
renderer's own formulas (`player/`). Its policy forbids it to load or send anything.
"""

from __future__ import annotations

import base64
import html
import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import InputError
from ..model.scene import Scene
from ..system.atomic import whole_file
from .html_data import CHANNELS, Quantized, pack, quantize

FORMAT = "endoprior-player-1"
"""Name and version of the data in the page."""
DEFAULT_TITLE = "EndoPrior-GS scene"
DEFLATE_LEVEL = 6
"""zlib level: 9 saves 2 % and takes three times as long."""
PLAYER = Path(__file__).parent / "player"
SCRIPTS = ("unpack.js", "sort.js", "camera.js", "shaders.js", "draw.js", "player.js")


def write_html(
    scene: Scene, out: Path, *, title: str = "", times: list[float] | None = None, max_bytes: int = 20_000_000
) -> Path:
    """Write a single-file player of `scene`: a web page that opens from disk and needs nothing else.

    It draws the Gaussians at the moments given, from the cameras that recorded them or from anywhere. What was rounded:
    see `html_data`; centers are off by at most 0.05 mm and an eighth of a pixel per axis at the working distance,
    rotations by half a degree, scales by 1 %, opacities by 0.0005, colors by half of an 8-bit level. Colors are those
    seen from the recorded camera of each moment, from wherever one looks. A page that would be too large is refused,
    never thinned out or rounded harder.

    Args:
        out: file to write; one that is there is replaced, and missing folders are made.
        title: shown on top and in the browser's tab.
        times: T moments in [0, 1], in order; None: those of the recorded frames.
        max_bytes: largest size of the file.
    Returns:
        `out`.
    Raises:
        InputError: `out` is a folder, there is no moment, the times are not increasing, no Gaussian can be drawn, or
            the page would exceed `max_bytes`.
        ValueError: a time is not in [0, 1].
    """
    out = Path(out)
    if out.is_dir():
        raise InputError(f"{out}: expected a file to write; got a folder. Add a name such as {out / 'scene.html'}.")
    if times is None:
        times = [i / len(scene.cameras) for i in range(len(scene.cameras))]
    if not times or any(b <= a for a, b in pairwise(times)):
        raise InputError(f"times: expected one or more increasing moments; got {times}. List each moment once.")
    quantized = quantize(scene, times)
    data, channels = pack(quantized.values, DEFLATE_LEVEL)
    page = _page(title or DEFAULT_TITLE, _about(scene, times, quantized, channels), data).encode()
    if len(page) > max_bytes:
        what = f"{len(times)} moments of {quantized.values.shape[2]} Gaussians"
        raise InputError(
            f"{out}: expected at most {max_bytes / 1e6:.1f} MB; got {len(page) / 1e6:.1f} MB for {what}. "
            "Choose fewer moments with --times (the size follows their number), or raise --max-mb."
        )
    with whole_file(out) as temporary:
        temporary.write_bytes(page)
    return out


def _about(scene: Scene, times: list[float], quantized: Quantized, channels: list[dict[str, int]]) -> dict[str, Any]:
    """What the page needs to know of the data: JSON, `channels` in the order of their streams."""
    cameras = [scene.camera_at(time) for time in times]
    rows = [[c.fx, c.fy, c.cx, c.cy, *c.world_to_camera.ravel().tolist()] for c in cameras]
    if np.ptp(rows, axis=0).max() == 0:
        rows = rows[:1]
    steps = zip(CHANNELS, quantized.low.tolist(), quantized.step.tolist(), channels, strict=True)
    return {
        "format": FORMAT,
        "width": cameras[0].width,
        "height": cameras[0].height,
        "cameras": rows,
        "seconds": [time * len(scene.cameras) / scene.frames_per_second for time in times],
        "gaussians": quantized.values.shape[2],
        "focus": quantized.focus,
        "depth_range": quantized.depth_range,
        "channels": [{"name": name, "low": low, "step": step, **coded} for name, low, step, coded in steps],
    }


def _page(title: str, about: dict[str, Any], data: bytes) -> str:
    script = "\n".join((PLAYER / name).read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "TITLE": html.escape(title),
        "STYLE": (PLAYER / "player.css").read_text(encoding="utf-8"),
        "ABOUT": json.dumps(about, allow_nan=False).replace("<", "\\u003c"),
        "DATA": base64.b64encode(data).decode(),
        "SCRIPT": script,
    }
    template = (PLAYER / "player.html").read_text(encoding="utf-8")
    return re.sub(r"@@([A-Z]+)@@", lambda found: parts[found[1]], template)
