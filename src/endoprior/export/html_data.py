"""The moving Gaussians of a scene as small integers, coded over time: the data of the HTML player.

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

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.types import Camera, Splats
from ..model.playback import faded
from ..model.scene import Scene, Shown
from ..render.constants import ALPHA_MIN, NEAR_Z
from ..render.projection import color_slopes
from ..render.sh import colors

CHANNELS = (
    *("x", "y", "z", "qw", "qx", "qy", "qz", "sx", "sy", "sz", "opacity"),
    *("r", "g", "b", "r1", "g1", "b1", "r2", "g2", "b2"),
)
LARGEST = 65535
"""Largest stored integer."""
MAX_STEP_MM = 0.1
"""Centers are off by half a step: never by more than 0.05 mm ..."""
STEP_PX = 0.25
"""... nor, at the working distance, by more than an eighth of a pixel on each axis."""
QUAT_STEP = 1 / 255
"""Of a component of the unit quaternion; turns a Gaussian by less than half a degree."""
LOG_SCALE_STEP = 0.02
"""A scale is off by at most 1 %."""
SMALLEST_SCALE_PX = 0.02
"""Scales below this at the working distance are stored as this: the renderer's blur is 27 times wider."""
OPACITY_STEP = 1 / 1020
COLOR_STEP = 1 / 255
SLOPE_STEP = 1 / 510
LARGEST_SLOPE = 8
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
    depth_range: tuple[float, float]
    """1st and 99th percentile of z of the visible Gaussians, at least 1 % apart, mm."""
    focus: float
    """Median z, mm: a free view turns around a point at this depth."""

    @property
    def steps(self) -> range:
        """The time steps that show it."""
        return range(self.first, self.first + self.values.shape[1])


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
    """Args: as `_sample` returns them; `raw` is changed. None: nothing is visible."""
    opacity = raw[CHANNELS.index("opacity")]
    finite = np.isfinite(raw).all(0)
    visible_depths = depths[finite & (depths > NEAR_Z) & (opacity >= ALPHA_MIN)]
    if not len(visible_depths):
        return None
    near, focus, far = (float(v) for v in np.percentile(visible_depths, [1, 50, 99]))
    step = np.array(
        [min(MAX_STEP_MM, STEP_PX * near / focal)] * 3
        + [QUAT_STEP] * 4
        + [LOG_SCALE_STEP] * 3
        + [OPACITY_STEP]
        + [COLOR_STEP] * 3
        + [SLOPE_STEP] * 6
    )
    raw[:, ~finite] = 0
    centers = raw[:3].reshape(3, -1)
    middle = np.median(centers[:, finite.ravel()], axis=1)
    within = (np.abs(centers - middle[:, None]) < step[:3, None] * (LARGEST // 2)).all(0).reshape(finite.shape)
    visible = finite & within & (opacity >= ALPHA_MIN)
    kept = visible.any(0)
    if not kept.any():
        return None
    raw, visible = raw[:, :, kept], visible[:, kept]

    low = np.zeros(len(CHANNELS))
    low[:3] = np.where(visible, raw[:3], np.inf).min((1, 2))
    low[3:7] = -1
    low[7:10] = np.log(SMALLEST_SCALE_PX * near / focal)
    low[14:] = -LARGEST_SLOPE
    raw[CHANNELS.index("opacity")] *= visible
    values = np.empty(raw.shape, np.uint16)
    for c in range(len(CHANNELS)):
        values[c] = np.rint((raw[c] - float(low[c])) / float(step[c])).clip(0, LARGEST)
    _repeat_hidden(values, visible)
    return Block(first, values, low, step, (near, max(far, near * 1.01)), focus)


def pack(values: NDArray[np.uint16], level: int = 9) -> tuple[bytes, list[dict[str, int]]]:
    """Code (C, T, N) integers over time and deflate them, one zlib stream per channel.

    A stream unpacks to a plane of low bytes and one of high bytes, Gaussian by Gaussian: the first frame, then T - 1
    residuals r, each as the unsigned 2 r (r >= 0) or -2 r - 1.

    Returns:
        the streams one after the other, and for each channel its number of `bytes` and its `order`: 0 for a channel
        that never changes (N values), 1 and 2 for the two predictions (N * T values).
    """
    streams, table = [], []
    for plane in values:
        order, coded = _predict(plane)
        by_gaussian = np.ascontiguousarray(coded.T)
        low, high = (by_gaussian & 255).astype(np.uint8), (by_gaussian >> 8).astype(np.uint8)
        streams.append(zlib.compress(low.tobytes() + high.tobytes(), level))
        table.append({"order": order, "bytes": len(streams[-1])})
    return b"".join(streams), table


def _predict(plane: NDArray[np.uint16]) -> tuple[int, NDArray[np.uint16]]:
    """Order of the prediction, and (T, N) first frame and residuals; (1, N) where nothing changes."""
    if (plane == plane[:1]).all():
        return 0, plane[:1]
    velocity = np.diff(plane, axis=0)
    first, second = _zigzag(velocity), _zigzag(np.diff(velocity, axis=0))
    # Bits follow the logarithm. The first step has no velocity before it to be predicted from.
    if (
        len(plane) > 2
        and np.log2(1 + second.astype(np.float32)).sum() < np.log2(1 + first[1:].astype(np.float32)).sum()
    ):
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
    pose = torch.as_tensor(camera.world_to_camera, dtype=torch.float32)
    towards = splats.means - torch.as_tensor(camera.center, dtype=torch.float32)
    towards = towards / towards.norm(dim=-1, keepdim=True)
    quats = splats.quats / splats.quats.norm(dim=-1, keepdim=True)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    parts = [
        splats.means,
        quats,
        splats.scales.clamp(min=1e-30).log(),
        splats.opacities[:, None],
        colors(splats.sh, towards),
        color_slopes(splats).flatten(1),
    ]
    return torch.cat(parts, 1).T.numpy(), (splats.means @ pose[2, :3] + pose[2, 3]).numpy()


def _repeat_hidden(values: NDArray[np.uint16], visible: NDArray[np.bool_]) -> None:
    """Where a Gaussian is invisible, repeat its numbers of the time step before: they compress to nothing."""
    opacity = CHANNELS.index("opacity")
    for t in range(1, values.shape[1]):
        hidden = ~visible[t]
        values[:opacity, t, hidden] = values[:opacity, t - 1, hidden]
        values[opacity + 1 :, t, hidden] = values[opacity + 1 :, t - 1, hidden]


def _zigzag(residual: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Residuals modulo 2**16 as small unsigned numbers: 0, -1, 1, -2 ... become 0, 1, 2, 3 ..."""
    signed = residual.view(np.int16)
    return ((signed << 1) ^ (signed >> 15)).view(np.uint16)
