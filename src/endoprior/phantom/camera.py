"""The phantom's cameras, and the path of a moving endoscope.

A moving endoscope makes excursions of about 300 frames: each pans along the tissue, turns the view to another side,
rolls, retreats, approaches and returns to exactly the pose in which it began. World axes are those of the left camera
of frame 0, mm. Each move is a quintic step up and one down: speed and acceleration are continuous.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig
from .motion import smooth_step
from .surface import Plane

EXCURSION_FRAMES = 300
SLOW_FRAMES = 130, 240
"""An excursion with fewer frames covers less distance, or turns less, in proportion: speeds stay those of a hand."""
_PAN, _TURN, _ROLL = (0.07, 0.24, 0.80, 0.96), (0.28, 0.43, 0.62, 0.78), (0.44, 0.58, 0.79, 0.95)
"""When a move starts, is complete, starts to go back and has gone back, as shares of the excursion."""
_RETREAT, _APPROACH = (0.42, 0.56, 0.58, 0.76), (0.58, 0.76, 0.78, 0.94)
_LOWEST_MM, _HIGHEST_MM = -12.0, 26.0
"""Heights between which the tissue at rest lies."""
_PAD_MM = 6.0
"""Margin of the material around all that any pose shows."""


@dataclass(frozen=True)
class CameraPose:
    """Where a camera is, in outer axes: of the world for the endoscope's left camera, of that one for all others."""

    center: NDArray[np.float64]
    """(3,) mm."""
    rotation: NDArray[np.float64]
    """(3, 3) rotation of the camera's axes to the outer ones."""

    @staticmethod
    def of(camera_to_world: NDArray[np.float64]) -> CameraPose:
        """The pose of a (4, 4) matrix."""
        return CameraPose(camera_to_world[:3, 3], camera_to_world[:3, :3])

    @staticmethod
    def moved_right(x_mm: float) -> CameraPose:
        """A camera with the outer axes, moved along x."""
        return CameraPose(np.array([x_mm, 0.0, 0.0]), np.eye(3))

    def to_camera(self, points: NDArray) -> NDArray[np.float64]:
        """Points (..., 3) of the outer axes in the axes of this camera, mm."""
        return (points - self.center) @ self.rotation

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """(4, 4) rigid transform from the outer axes."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation.T, -self.rotation.T @ self.center
        return pose


AT_ORIGIN = CameraPose.moved_right(0.0)
"""A camera at the origin of the outer axes, turned like them."""


@dataclass(frozen=True)
class Excursion:
    """How far one excursion goes."""

    pan: NDArray[np.float64]
    """(3,) translation along the tissue, mm."""
    pan_turn: NDArray[np.float64]
    turn: NDArray[np.float64]
    """(2,) rotation vectors (about x and y) of the view while it pans, and of the look to another side, rad."""
    roll: float
    """Rotation about the optical axis, rad."""
    retreat: float
    approach: float
    """mm back and forward along the optical axis."""

    def camera_to_world(self, local: float) -> NDArray[np.float64]:
        """(4, 4) pose at time `local` in [0, 1] of the excursion; the identity at both ends."""
        pan, turned, rolled, back, ahead = (
            smooth_step(start, done, local) * (1 - smooth_step(returns, ends, local))
            for start, done, returns, ends in (_PAN, _TURN, _ROLL, _RETREAT, _APPROACH)
        )
        angle = rolled * self.roll
        roll = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.append(pan * self.pan_turn + turned * self.turn, 0.0))[0] @ roll
        pose[:3, 3] = pan * self.pan + (ahead * self.approach - back * self.retreat) * pose[:3, 2]
        return pose


@dataclass(frozen=True)
class CameraPath:
    """The poses of the endoscope's left camera; one that stands still has no excursions."""

    excursions: tuple[Excursion, ...]

    def camera_to_world(self, phase: float) -> NDArray[np.float64]:
        """(4, 4) pose, mm, at time `phase` in [0, 1]."""
        if not self.excursions:
            return np.eye(4)
        count = len(self.excursions)
        k = min(int(phase * count), count - 1)
        return self.excursions[k].camera_to_world(phase * count - k)

    def poses(self, frames: int) -> NDArray[np.float64]:
        """(frames, 4, 4) poses of all frames, mm."""
        return np.stack([self.camera_to_world(index / (frames - 1)) for index in range(frames)])


def build_camera_path(cfg: PhantomConfig, plane: Plane) -> CameraPath:
    """Choose the excursions of one seed; each goes another way."""
    if cfg.camera == "still":
        return CameraPath(())
    rng = np.random.default_rng([cfg.seed, 8])
    count = max(1, round(cfg.frames / EXCURSION_FRAMES))
    length = (cfg.frames - 1) / count
    far, wide = (min(1.0, length / slow) for slow in SLOW_FRAMES)
    heading = rng.uniform(0, 2 * np.pi)
    excursions = []
    for _ in range(count):
        aside = _flat(heading, 0.5)
        back = _flat(heading + np.pi + rng.uniform(-1, 1), 0.0)
        excursions.append(
            Excursion(
                far * rng.uniform(18, 25) * (aside @ plane.axes[:2]),
                wide * np.deg2rad(rng.uniform(2, 5)) * _about(aside),
                wide * np.deg2rad(rng.uniform(11, 15)) * _about(back),
                wide * np.deg2rad(rng.uniform(11, 20)) * rng.choice([-1.0, 1.0]),
                far * rng.uniform(17, 21),
                far * rng.uniform(11, 15),
            )
        )
        heading += rng.uniform(1.9, 2.9)
    return CameraPath(tuple(excursions))


def _flat(heading: float, most_up: float) -> NDArray[np.float64]:
    """(2,) unit vector to the right and down; less upwards, where the tissue recedes."""
    way = np.array([np.cos(heading), max(np.sin(heading), -most_up)])
    return way / np.linalg.norm(way)


def _about(way: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) axis about which the optical axis turns towards `way` (right, down)."""
    return np.array([-way[1], way[0]])


def widened(plane: Plane, path: CameraPath, cfg: PhantomConfig) -> Plane:
    """The plane with a metric grid over all that any pose of `path` shows of the tissue."""
    (cx, cy), focal = cfg.center, cfg.focal
    corners = np.array([(x, y, focal) for x in (-cx, cfg.width - cx) for y in (-cy, cfg.height - cy)]) / focal
    poses = path.poses(min(cfg.frames, 200 * max(1, len(path.excursions))))
    turns = poses[:, :3, :3].transpose(0, 2, 1)
    rays = (corners @ turns)[:, None]
    eyes = np.array([[0.0, 0, 0], [cfg.baseline_mm, 0, 0]]) @ turns + poses[:, None, :3, 3]
    eyes = eyes[:, :, None] - plane.origin
    normal = plane.axes[2]
    found = []
    for height in (_LOWEST_MM - 0.8 * cfg.breathing_mm, _HIGHEST_MM):
        points = eyes + rays * ((height - eyes @ normal) / (rays @ normal))[..., None]
        found.append((points @ plane.axes[:2].T).reshape(-1, 2))
    pad = _PAD_MM + 0.4 * cfg.breathing_mm + 1.3 * cfg.slide_mm
    (a0, b0), (a1, b1) = np.concatenate(found).min(0) - pad, np.concatenate(found).max(0) + pad
    return replace(plane, window=(a0, a1, b0, b1), metric=True)
