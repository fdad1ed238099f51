"""A narrow nasal cavity, rigid: flat septum on the left, two turbinates on the right, the back wall ahead.

The camera drives slowly in and out, drifts and turns by up to 0.4 degrees a frame. Letters as in `tube`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .config import PhantomConfig
from .tube import Tube, from_first_frame, smooth_around, wall_texture

HALF_MM = 10.0, 18.0  # half of the width and of the height
IN_MM, CYCLE = 18.0, 80  # way in, and frames until the camera is back
BEHIND_MM, AHEAD_MM = 12.0, 48.0  # cavity behind the outermost camera, and ahead of the innermost one
MESH_MM = 0.5
MUCOSA = {"fine": 1.6, "contrast": 0.5, "gloss": 0.9}  # beside the wall of `tube`: smaller vessels, paler and wetter
DRIFT_MM = 1.4, 2.5  # amplitudes to the right and down, and ...
TURN_DEG = 1.9, 1.7, 2.2  # ... of pitch, yaw and roll


def build_sinus(cfg: PhantomConfig) -> Tube:
    """Cavity, texture and drive of one seed."""
    rng = np.random.default_rng([cfg.seed, 12])
    length = BEHIND_MM + IN_MM + AHEAD_MM
    s, around = np.arange(0, length, MESH_MM), 2 * np.pi * float(np.hypot(*HALF_MM)) / np.sqrt(2)
    angle = np.linspace(0, 2 * np.pi, round(around / MESH_MM) + 1)
    radius = _radius(s[:, None], angle[None], length, around, cfg.seed, rng)
    across, down = radius * np.cos(angle), radius * np.sin(angle)
    bend = (s / length)[:, None] ** 2 * rng.uniform(-4, 4, 2)  # the passage leads slightly aside
    vertices = np.stack([across + bend[:, :1], down + bend[:, 1:], np.broadcast_to(s[:, None], radius.shape)], -1)
    return from_first_frame(vertices, wall_texture(length, around, cfg.seed, **MUCOSA), _drive(cfg, rng))


def _radius(
    s: NDArray, angle: NDArray, length: float, around: float, seed: int, rng: np.random.Generator
) -> NDArray:  # fmt: skip
    """(MH, MW) distance of the wall from the axis, mm; the cavity is closed at its end."""
    wide, high = np.abs(np.cos(angle)) / HALF_MM[0], np.abs(np.sin(angle)) / HALF_MM[1]
    radius = (wide**2.6 + high**2.6) ** (-1 / 2.6)
    bulges = np.zeros_like(s + angle)
    for at in (-0.55, 0.6):  # the middle and the lower turbinate, each along most of the cavity
        along = np.exp(-(((s - rng.uniform(32, 42)) / rng.uniform(14, 20)) ** 4))
        off = (angle - at - rng.uniform(-0.1, 0.1) - 0.004 * s + np.pi) % (2 * np.pi) - np.pi
        bulges = bulges + rng.uniform(0.3, 0.4) * along * np.exp(-((off / 0.3) ** 2))
    spur = rng.uniform(0.1, 0.18) * np.exp(-(((s - rng.uniform(30, 45)) / 6) ** 2 + ((angle - np.pi) / 0.35) ** 2))
    swell = smooth_around(angle / (2 * np.pi) * around, s, around, 7.0, 3, seed + 300)
    closed = np.sqrt(np.clip((length - MESH_MM - s) / 14, 1e-8, 1))
    return radius * (1 - bulges - spur + 0.05 * swell) * closed


def _drive(cfg: PhantomConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """(T, 4, 4) poses: in and out along the axis, with drift and turns whose rhythms are not those of the way."""
    frame, phases = np.arange(cfg.frames), rng.uniform(0, 2 * np.pi, 5)
    lengths = rng.uniform(0.85, 1.15, 5) * (13, 17, 9, 11, 12)
    sway = np.sin(frame[:, None] / lengths + phases)
    poses = np.tile(np.eye(4), (cfg.frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", sway[:, 2:] * TURN_DEG, degrees=True).as_matrix()
    poses[:, :2, 3] = sway[:, :2] * DRIFT_MM
    poses[:, 2, 3] = BEHIND_MM + IN_MM * (1 - np.cos(2 * np.pi * frame / CYCLE)) / 2
    return poses
