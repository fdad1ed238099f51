"""One HTML file that plays a scene in a browser: no server, no network, nothing to install.

The page holds the Gaussians of every time step as deflated integers, window by window, unpacks a window when it is
needed, and renders them with WebGL 2 by the formulas of our renderer (`player/`). Its content security policy forbids
it to load or send anything.

The data are blocks: one for each window of the scene, with the time steps that show it. Where two windows overlap, a
time step shows two blocks, and the opacities of each contain how far it is faded.

Every Gaussian of a block has 20 channels, each `low + step * q` with q a 16-bit integer: center x, y, z (mm),
quaternion w, x, y, z, the logarithms of the three scales (mm), opacity, red, green, blue, and the change of these three
per standard deviation along the first and the second local axis. A channel that never changes is stored once. The
others store time step 0 and then the residual of a prediction from one step before (q[t-1]) or two (2 q[t-1] - q[t-2]),
whichever leaves less. Arithmetic is modulo 2**16, so that unpacking is exact. Shared letters: `T` time steps of a
block, `N` Gaussians, `C = 20` channels.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.checks import InputError, input_error
from ..core.geometry import length_unit
from ..core.types import Camera, Splats, frame_times
from ..model.carry import TIED_ANEW_PX
from ..model.photometric import GRID
from ..model.scene import Scene, Shown, faded
from ..model.uncertainty import ACROSS, CELLS, DRIFT, START, UNKNOWN_NOISE, Across, Along, half_width
from ..render.constants import ALPHA_MIN, NEAR_Z
from ..render.projection import color_slopes
from ..render.sh import colors
from ..system.atomic import whole_file
from ..system.parallel import frame_threads
from .formats import ExportFormat, ExportOptions, Progress

DATA_FORMAT = "endoprior-player-2"
"""Name and version of the data in the page."""
NOTHING_VISIBLE = "scene: expected Gaussians in front of the camera, got none that is visible. Fix: Train it again."
DEFAULT_TITLE = "EndoPrior-GS scene"
PACKING_BYTES = 40  # memory in which a thread packs a channel, bytes for each of its values
DEFLATE_LEVEL = 6
"""zlib level: 9 saves 2 % and takes three times as long."""
PLAYER = Path(__file__).parent / "player"
SCRIPTS = ("aside.js", "unpack.js", "blocks.js", "sort.js", "camera.js", "shaders.js", "draw.js")
SCRIPTS += ("ranges.js", "measure.js", "window.js", "player.js")


class PageTooLarge(InputError):
    """The page would exceed the limit."""

    def __init__(self, message: str, num_bytes: int) -> None:
        super().__init__(message)
        self.num_bytes = num_bytes
        """Size of the page; where packing stopped before its end, what it would be if all went on like that."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the page; see `write_html`."""
    times, max_bytes = list(options.times) or None, round(options.max_mb * 1e6)
    write_html(scene, out, title=options.title, times=times, max_bytes=max_bytes)
    progress(1, 1)


def write_html(
    scene: Scene,
    out: Path,
    *,
    title: str = "",
    remark: str = "",
    times: list[float] | None = None,
    max_bytes: int = 20_000_000,
) -> Path:
    """Write a single-file player of `scene`: a web page that opens from disk and needs nothing else.

    It renders the Gaussians at `times`, from the cameras of the sequence or from a free view. Rounding moves centers by
    at most 0.05 mm and an eighth of a pixel per axis at the working distance of a window, rotations by half a degree,
    scales by 1 %, opacities by 0.0005, colors by half of an 8-bit level. Colors are always those seen from the
    sequence's camera at that time. A page that would be too large is an error: nothing is left out or rounded further.

    Args:
        out: file to write; an existing one is replaced, and missing folders are created.
        title: at the top of the page and in the browser's tab.
        remark: a line below it, such as how good the scene is.
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
        times = frame_times(len(scene.cameras))
    if not times or any(b <= a for a, b in pairwise(times)):
        raise input_error("times", "one or more increasing times", f"{times}", "list each time once.")
    data, of_blocks = _packed_blocks(scene, times, out, max_bytes)
    about, unit = _about(scene, times), length_unit(scene.lengths_are_relative)
    page = _page(title or DEFAULT_TITLE, remark, unit, about | {"unit": unit} | of_blocks, data).encode()
    if len(page) > max_bytes:
        raise _too_large(out, max_bytes, len(page), len(times), of_blocks["gaussians"])
    with whole_file(out) as temporary:
        temporary.write_bytes(page)
    return out


def _packed_blocks(scene: Scene, times: list[float], out: Path, max_bytes: int) -> tuple[bytes, dict[str, Any]]:
    """The data of the page, and what it must know of them; errors as in `write_html`."""
    blocks, streams, num_shown, focus, depths = [], [], np.zeros(len(times), int), {}, []
    for block in quantized_blocks(scene, times):
        data, coded = pack(block.values)
        scaled = zip(block.low.tolist(), block.step.tolist(), coded, strict=True)
        channels = [{"low": low, "step": step, **stream} for low, step, stream in scaled]
        _, num_steps, num_gaussians = block.values.shape
        stop = block.first + num_steps
        blocks.append({"first": block.first, "steps": num_steps, "gaussians": num_gaussians, "channels": channels})
        streams.append(data)
        num_shown[block.first : stop] += num_gaussians
        near, focus[(block.first + stop - 1) / 2], far = block.depths
        depths += [near, far]
        size = 4 * math.ceil(sum(map(len, streams)) / 3)  # in Base64
        if size > max_bytes:
            raise _too_large(out, max_bytes, size * len(times) / stop, len(times), num_shown.max())
    if not blocks:
        raise InputError(NOTHING_VISIBLE)
    return b"".join(streams), {
        "gaussians": int(num_shown.max()),
        "focus": np.interp(range(len(times)), list(focus), list(focus.values())).round(3).tolist(),
        "depth_range": [min(depths), max(depths)],
        "channels": CHANNELS,
        "blocks": blocks,
    }


def _too_large(out: Path, max_bytes: int, num_bytes: float, num_times: int, num_gaussians: int) -> PageTooLarge:
    got = f"about {num_bytes / 1e6:.1f} MB for {num_times} time steps of {num_gaussians} Gaussians"
    fix = "choose fewer with --times (the size grows with their number), or raise --max-mb."
    error = input_error(out, f"at most {max_bytes / 1e6:.1f} MB", got, fix)
    return PageTooLarge(str(error), math.ceil(num_bytes))


def _about(scene: Scene, times: list[float]) -> dict[str, Any]:
    """What the page knows of the sequence, for JSON; its smoke as `most` and `texels`, see `_packed_smoke`."""
    cameras = [scene.camera_at(time) for time in times]
    rows = [[c.fx, c.fy, c.cx, c.cy, *c.world_to_camera.ravel().tolist()] for c in cameras]
    if np.ptp(rows, axis=0).max() == 0:
        rows = rows[:1]
    grids = [scene.smoke_at(time) for time in times]
    smoke = {"smoke": _packed_smoke(grids)} if any(grid is not None for grid in grids) else {}
    return smoke | {
        "format": DATA_FORMAT,
        "width": cameras[0].width,
        "height": cameras[0].height,
        "cameras": rows,
        "background": list(scene.background),
        "seconds": [time * len(scene.cameras) / scene.frames_per_second for time in times],
        "ranges": _ranges(scene, times),
    }


def _ranges(scene: Scene, times: list[float]) -> dict[str, Any]:
    """What the page needs for ranges: the numbers of `uncertainty`, with the half width of 95 % in place of degrees of
    freedom; the noise of depth at each time, as a share of it; and which cells show tissue, one bit each.
    """

    def row(of: Across | Along) -> list[float]:
        *shares, freedom = of
        return [*shares, half_width(freedom)]

    shown = [scene.window_at(min(round(time * len(scene.cameras)), len(scene.cameras) - 1)) for time in times]
    masks = [
        np.ones(CELLS, bool) if window.tissue is None else window.tissue[own].numpy() >= 128 for window, own in shown
    ]
    bits = b"".join(np.packbits(mask).tobytes() for mask in masks)
    return {
        "across": [row(of) for of in ACROSS],
        "drift": [row(of) for of in DRIFT],
        "start": [START.depth, half_width(START.freedom)],
        "noise": [window.depth_noise or UNKNOWN_NOISE for window, _ in shown],
        "tied_anew": TIED_ANEW_PX**2,
        "cells": CELLS,
        "tissue": base64.b64encode(bits).decode(),
    }


def _packed_smoke(grids: Sequence[Tensor | None]) -> dict[str, Any]:
    """Size of the grids of smoke, largest value, and in Base64 the root of each as a share of its own, 0..255.

    A root is off by half a level of color at most. Time steps without smoke let all light through.
    """
    clear = torch.zeros((*GRID, 2)).index_fill_(2, torch.tensor([0]), 1.0)
    roots = torch.stack([clear if grid is None else grid for grid in grids]).sqrt()
    most = float(roots.max())
    texels = (roots * (255 / most)).round().to(torch.uint8).numpy().tobytes()
    return {"size": roots.shape[1:3], "most": most, "texels": base64.b64encode(texels).decode()}


def _page(title: str, remark: str, unit: str, about: dict[str, Any], data: bytes) -> str:
    def read(name: str) -> str:
        return (PLAYER / name).read_text(encoding="utf-8")

    parts = {
        "TITLE": html.escape(title),
        "REMARK": f'<p id="remark">{html.escape(remark)}</p>' if remark else "",
        "STYLE": read("player.css"),
        "UNIT": unit,
        "ABOUT": json.dumps(about, allow_nan=False).replace("<", "\\u003c"),
        "DATA": base64.b64encode(data).decode(),
        "SCRIPT": "\n".join(map(read, SCRIPTS)),
    }
    return re.sub(r"@@([A-Z]+)@@", lambda match: parts[match[1]], read("player.html"))


# The data.

CHANNELS = ("x", "y", "z", "qw", "qx", "qy", "qz", "sx", "sy", "sz", "opacity", "r", "g", "b")
CHANNELS += ("r1", "g1", "b1", "r2", "g2", "b2")
OPACITY = CHANNELS.index("opacity")
MAX_UINT16 = 65535
"""Largest stored integer."""
MAX_STEP_MM, STEP_PX = 0.1, 0.25
"""Centers are off by half a step: never by more than 0.05 mm, nor, at the working distance, by more than an eighth of a
pixel on each axis."""
QUAT_STEP, LOG_SCALE_STEP, OPACITY_STEP, COLOR_STEP, SLOPE_STEP = 1 / 255, 0.02, 1 / 1020, 1 / 255, 1 / 510
"""A component of the unit quaternion turns a Gaussian by less than half a degree; a scale is off by at most 1 %."""
MIN_SCALE_PX = 0.02
"""Scales below this at the working distance are stored as this: the renderer's blur is 27 times wider."""
MAX_SLOPE = 8
"""A color would change by its whole range within an eighth of a standard deviation."""


@dataclass(frozen=True)
class Block:
    """The Gaussians of one window at successive time steps, as integers."""

    first: int
    """The first of its time steps."""
    values: NDArray[np.uint16]
    """(C, T, N)."""
    low: NDArray[np.float64]
    """(C,) what q = 0 stands for."""
    step: NDArray[np.float64]
    """(C,)."""
    depths: tuple[float, float, float]
    """1st, 50th and 99th percentile of z of the visible Gaussians, mm, the outer at least 1 % apart; a free view turns
    around a point at the median."""


def quantized_blocks(scene: Scene, times: list[float]) -> Iterator[Block]:
    """The Gaussians of `scene` at `times`, window by window, without those that are never visible.

    Colors are those seen from the sequence's camera at each time, with all degrees of the harmonics. A Gaussian counts
    as invisible at a time, and its opacity is stored as 0, if its opacity is below 1/255, if a value of it is not
    finite, or if it is too far away for 16 bits. A window in which nothing is visible is left out.

    Args:
        times: increasing times in [0, 1].
    Raises:
        ValueError: a time is not in [0, 1].
    """
    cameras = [scene.camera_at(time) for time in times]
    focal = max(max(camera.fx, camera.fy) for camera in cameras)
    shown: dict[int, list[tuple[int, Shown]]] = {}
    for t, time in enumerate(times):
        for part in scene.shown_at(time):
            shown.setdefault(part.window.start, []).append((t, part))
    for steps in shown.values():
        first, last = steps[0][0], steps[-1][0]
        raw, depths = _sample([part for _, part in steps], cameras[first : last + 1])
        block = _quantize(raw, depths, first, focal)
        if block is not None:
            yield block


def _quantize(raw: NDArray[np.float32], depths: NDArray[np.float32], first: int, focal: float) -> Block | None:
    """The block of what `_sample` returns, which is changed; None: nothing is visible."""
    finite, opaque = np.isfinite(raw).all(0), raw[OPACITY] >= ALPHA_MIN
    visible_depths = depths[finite & (depths > NEAR_Z) & opaque]
    if not len(visible_depths):
        return None
    near, focus, far = (float(v) for v in np.percentile(visible_depths, [1, 50, 99]))
    steps = min(MAX_STEP_MM, STEP_PX * near / focal), QUAT_STEP, LOG_SCALE_STEP, OPACITY_STEP, COLOR_STEP, SLOPE_STEP
    step = np.repeat(steps, (3, 4, 3, 1, 3, 6))
    raw[:, ~finite] = 0
    middle = np.median(raw[:3, finite], axis=1)
    within = (np.abs(raw[:3] - middle[:, None, None]) < step[:3, None, None] * (MAX_UINT16 // 2)).all(0)
    visible = finite & within & opaque
    kept = visible.any(0)
    if not kept.any():
        return None
    raw, visible = raw[:, :, kept], visible[:, kept]

    low = np.zeros(len(CHANNELS))
    low[:3] = np.where(visible, raw[:3], np.inf).min((1, 2))
    low[3:7] = -1
    low[7:10] = np.log(MIN_SCALE_PX * near / focal)
    low[14:] = -MAX_SLOPE
    raw[OPACITY] *= visible
    values = np.empty(raw.shape, np.uint16)
    for c in range(len(CHANNELS)):
        values[c] = np.rint((raw[c] - float(low[c])) / float(step[c])).clip(0, MAX_UINT16)
    # Where a Gaussian is invisible, its other numbers repeat those of the time step before: they compress to nothing.
    for channels in (values[:OPACITY], values[OPACITY + 1 :]):
        for t in range(1, len(visible)):
            channels[:, t, ~visible[t]] = channels[:, t - 1, ~visible[t]]
    return Block(first, values, low, step, (near, focus, max(far, near * 1.01)))


def pack(values: NDArray[np.uint16]) -> tuple[bytes, list[dict[str, int]]]:
    """Code (C, T, N) integers over time and deflate them, one zlib stream per channel.

    A stream unpacks to a plane of low bytes and one of high bytes, Gaussian by Gaussian: the first frame, then T - 1
    residuals r, each as the unsigned 2 r (r >= 0) or -2 r - 1.

    Returns:
        the streams one after the other, and for each channel its number of `bytes` and its `order`: 0 for a channel
        that never changes (N values), 1 and 2 for the two predictions (N * T values).
    """

    def packed(plane: NDArray[np.uint16]) -> tuple[int, bytes]:
        order, coded = _predict(plane)
        by_gaussian = np.ascontiguousarray(coded.T)
        low, high = (by_gaussian & 255).astype(np.uint8), (by_gaussian >> 8).astype(np.uint8)
        return order, zlib.compress(low.tobytes() + high.tobytes(), DEFLATE_LEVEL)

    with frame_threads(PACKING_BYTES * values[0].size) as pool:
        done = list(pool.map(packed, values))
    return b"".join(stream for _, stream in done), [{"order": order, "bytes": len(stream)} for order, stream in done]


def _predict(plane: NDArray[np.uint16]) -> tuple[int, NDArray[np.uint16]]:
    """Order of the prediction, and (T, N) first frame and residuals; (1, N) where nothing changes."""
    if (plane == plane[:1]).all():
        return 0, plane[:1]
    velocity = np.diff(plane, axis=0)
    first, second = _zigzag(velocity), _zigzag(np.diff(velocity, axis=0))
    # Bits follow the logarithm. The first step has no velocity before it to be predicted from.
    bits = [np.log2(1 + left.astype(np.float32)).sum() for left in (first[1:], second)]
    if len(plane) > 2 and bits[1] < bits[0]:
        return 2, np.concatenate([plane[:1], first[:1], second])
    return 1, np.concatenate([plane[:1], first])


def _sample(shown: list[Shown], cameras: list[Camera]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(C, T, N) channels of one window before rounding, and (T, N) z in the camera at each time, mm."""
    scene = shown[0].window.scene
    raw = np.empty((len(CHANNELS), len(shown), len(scene)), np.float32)
    depths = np.empty((len(shown), len(scene)), np.float32)
    for t, (part, camera) in enumerate(zip(shown, cameras, strict=True)):
        raw[:, t], depths[t] = _channels(faded(scene.at(part.time), part.weight), camera)
        if t:  # q and -q are one rotation: take the one nearer to the time step before
            raw[3:7, t] *= np.where((raw[3:7, t] * raw[3:7, t - 1]).sum(0) < 0, -1, 1)
    return raw, depths


def _channels(splats: Splats, camera: Camera) -> tuple[NDArray, NDArray]:
    """(C, N) channels, and (N,) z in the camera, mm."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=torch.float32)
    towards = splats.means - torch.as_tensor(camera.center, dtype=torch.float32)
    towards = towards / towards.norm(dim=-1, keepdim=True)
    quats = splats.quats / splats.quats.norm(dim=-1, keepdim=True)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    form = [splats.means, quats, splats.scales.clamp(min=1e-30).log(), splats.opacities[:, None]]
    channels = torch.cat([*form, colors(splats.sh, towards), color_slopes(splats).flatten(1)], 1)
    return channels.T.numpy(), (splats.means @ pose[2, :3] + pose[2, 3]).numpy()


def _zigzag(residual: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Residuals modulo 2**16 as small unsigned numbers: 0, -1, 1, -2 ... become 0, 1, 2, 3 ..."""
    signed = residual.view(np.int16)
    return ((signed << 1) ^ (signed >> 15)).view(np.uint16)


FORMAT = ExportFormat((".html",), ("times", "title", "max_mb"), write=write, holds="a player")
