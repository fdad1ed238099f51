"""Motion of tissue and instruments: breathing, sliding, pulls by the grasper, paths of the instrument tips.

Every motion is a product of smooth functions of place and time (quintic steps, cosines, Gaussians; of place, the
equilibria of `mechanics`), so that velocities are continuous. `phase` is time as a fraction of the sequence, in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config import NARROW_PULL_MM, PhantomConfig
from .mechanics import GROWTH_PER_MM, Load, solve_sheet
from .surface import Anatomy, Plane, organs_at

_BREATH_FRAMES = 40
_PULL_FRAMES = 48
_WIDE_MM, _NARROW_MM, _NARROW_SHARE = 14.0, 5.2, 0.45
"""A pull moves a broad neighborhood, plus a narrow peak around the jaws."""
_NEARER, _HIGHER_MM = 0.3, 5.0
"""Where the second tool of most families moves: at this share of the distance from the center of that of `graspers`,
and so much nearer to the camera."""


def smooth_step(low: float, high: float, x: float) -> float:
    """0 below `low`, 1 above `high`, a quintic with continuous second derivative between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * t * (t * (t * 6 - 15) + 10)


def _breath(phase: float, frames: int) -> float:
    """How far the cycle of breathing is, rad."""
    return 2 * np.pi * phase * (frames - 1) / _BREATH_FRAMES


@dataclass(frozen=True)
class Pull:
    """One grasp: where, which way, when."""

    center: NDArray[np.float64]
    """(2,) grasped point in plane coordinates, mm."""
    height: float
    """Rest height of the surface there, mm."""
    vector: NDArray[np.float64]
    """(3,) displacement at the grasped point when fully pulled, along e_a, e_b, normal, mm."""
    start: float
    length: float
    """Phase at which this cycle of approach, pull and release begins, and its duration."""
    width: float = 1.0
    """Factor of the size of the moved neighborhood."""

    def strength(self, phase: float) -> float:
        """0..1: how far the pull has gone."""
        local = (phase - self.start) / self.length
        return smooth_step(0.22, 0.50, local) * (1 - smooth_step(0.60, 0.84, local))

    def weight(self, a: NDArray, b: NDArray) -> NDArray:
        """(...,) share of the pull at plane points, 1 at its center."""
        square = ((a - self.center[0]) ** 2 + (b - self.center[1]) ** 2) / self.width**2
        narrow, wide = np.exp(-square / (2 * _NARROW_MM**2)), np.exp(-square / (2 * _WIDE_MM**2))
        return _NARROW_SHARE * narrow + (1 - _NARROW_SHARE) * wide


@dataclass(frozen=True)
class ToolPose:
    """Pose of an instrument at one time, in world axes, mm."""

    pivot: NDArray[np.float64]
    """(3,) point the shaft always passes through (the port in the abdominal wall)."""
    tip: NDArray[np.float64]
    """(3,) point between the jaws, 2 mm behind their ends."""
    opening: float
    """Angle between the jaws, rad."""
    roll: float
    """Rotation of the hinge about the jaws' direction, rad."""


@dataclass(frozen=True)
class PhantomMotion:
    """The motion of tissue and tools for one seed."""

    plane: Plane
    anatomy: Anatomy
    frames: int
    breathing_mm: float
    slide_mm: float
    pulls: tuple[Pull, ...]
    idles: NDArray[np.float64]
    """(cycles + 1, 3) positions (a, b, height) of the grasper between grasps, mm."""
    hover: NDArray[np.float64]
    """(6,) second tool: center (a, b, height), sweep (a, b) in mm, time shift in rad."""
    side: float
    """+1: the grasper enters from the right, -1: from the left."""
    loads: tuple[Load, ...] = ()
    """Move the tissue by a law of mechanics, in place of the closed forms."""
    pokes: bool = False
    """Whether the jaws stay closed."""

    def displacement(self, a: NDArray, b: NDArray, phase: float) -> NDArray[np.float64]:
        """(..., 3) motion away from rest along e_a, e_b and the normal, mm, at plane points `a, b`."""
        if self.loads:
            strengths = [load.strength(phase) for load in self.loads]
            carried = [load.sheet.displacement(a, b, s) for load, s in zip(self.loads, strengths, strict=True) if s > 0]
            return np.sum([np.zeros((*np.shape(a), 3)), *carried], 0)
        cycle = _breath(phase, self.frames)
        # The tissue swells and slides; distant parts lag slightly and move slightly less.
        lag = 0.006 * a - 0.009 * b
        swell = 0.5 * self.breathing_mm * (np.sin(cycle - lag) + 0.18 * np.sin(2 * (cycle - lag) + 0.7))
        slide = 0.3 * self.breathing_mm * np.sin(cycle - lag - 0.5)
        reach = 1 + 0.25 * np.cos(0.035 * a + 0.9) * np.cos(0.03 * b - 0.4)
        moved = np.stack([0.35 * slide * reach, -slide * reach, swell * reach], -1)
        if self.slide_mm > 0:
            # To one side and then to the other in each cycle of a pull, which is strongest when the slide is at rest.
            moved[..., 0] += self.side * self.slide_mm * np.sin(2 * np.pi * phase * len(self.pulls)) * reach
        for pull in self.pulls:
            strength = pull.strength(phase)
            if strength > 0:
                moved = moved + (strength * pull.weight(a, b))[..., None] * pull.vector
        return moved

    def held(self, pull: Pull, phase: float) -> NDArray[np.float64]:
        """(3,) position in world axes of the surface point grasped by `pull`, mm."""
        a, b = pull.center
        moved = self.displacement(np.array(a), np.array(b), phase)
        return self.plane.lift(a + moved[0], b + moved[1], pull.height + moved[2])

    def tools(self, phase: float) -> tuple[ToolPose, ToolPose]:
        """The grasper and the hovering instrument."""
        k = min(int(phase * len(self.pulls)), len(self.pulls) - 1)
        pull = self.pulls[k]
        local = (phase - pull.start) / pull.length
        held = self.held(pull, phase)
        leaving = local > 0.5
        idle = self.plane.lift(*self.idles[k + 1 if leaving else k])
        near = 1 - smooth_step(0.72, 1.0, local) if leaving else smooth_step(0.0, 0.19, local)
        tip = idle + near * (held - idle)
        closed = smooth_step(0.15, 0.23, local) * (1 - smooth_step(0.66, 0.74, local))
        closed = 1.0 if self.pokes else closed
        grasper = ToolPose(np.array([self.side * 66.0, 50.0, 12.0]), tip, 0.05 + 0.60 * (1 - closed), 0.15 * near)
        a, b, height, sweep_a, sweep_b, shift = self.hover
        swing = 2 * np.pi * phase * max(1.0, self.frames / 64) + shift
        wander = self.plane.lift(
            a + sweep_a * np.sin(swing), b + sweep_b * np.cos(0.8 * swing), height + 2 * np.cos(swing)
        )
        opening = 0.30 + 0.22 * np.sin(1.7 * swing)
        second = ToolPose(np.array([-self.side * 72.0, 34.0, 20.0]), wander, opening, -0.5)
        return grasper, second


def build_motion(cfg: PhantomConfig, plane: Plane, anatomy: Anatomy) -> PhantomMotion:
    """Choose the motion of one seed: the grasper takes the main_loop loop, each time at another place."""
    rng = np.random.default_rng([cfg.seed, 4])
    side = float(rng.choice([-1.0, 1.0]))
    cycles = max(1, round(cfg.frames / _PULL_FRAMES))
    main_loop = anatomy.paths[0].astype(float)
    # Grasp only the part of the loop inside the image.
    central = main_loop[(np.abs(main_loop[:, 0]) < 20) & (np.abs(main_loop[:, 1]) < 16)]
    pulls, idles = [], []
    for k in range(cycles + 1):
        center = central[rng.integers(len(central))] + rng.normal(0, 1.0, 2)
        # Idle positions stay near the center, so that the tool never leaves the image.
        idle = np.clip(center + np.array([side * rng.uniform(2, 10), rng.uniform(3, 9)]), [-11, -10], [11, 6])
        idles.append([*idle, rng.uniform(25, 30)])
        if k < cycles:
            away = _away(cfg, side, rng.uniform(0.3, 0.75), rng.uniform(-0.35, 0.35), rng.uniform(0.65, 0.9))
            height = float(organs_at(anatomy, *center.reshape(2, 1, 1)).height[0, 0])
            vector, width = cfg.pull_mm * away, max(1.0, cfg.pull_mm / NARROW_PULL_MM)
            pulls.append(Pull(center, height, vector, k / cycles, 1 / cycles, width))
    hover = [-side * rng.uniform(17, 24), rng.uniform(8, 14), rng.uniform(21, 25)]
    hover += [rng.uniform(5, 9), rng.uniform(4, 7), rng.uniform(0, 6.3)]
    if cfg.instruments != "graspers":
        hover[0], hover[2] = _NEARER * hover[0], hover[2] + _HIGHER_MM  # thin tools would hardly be in the image
    motion = cfg.breathing_mm, cfg.slide_mm, tuple(pulls), np.array(idles), np.array(hover), side
    loads = _loads(cfg, anatomy, pulls)
    return PhantomMotion(plane, anatomy, cfg.frames, *motion, loads, pokes=cfg.mechanics == "poke")


def _away(cfg: PhantomConfig, side: float, less: float, along: float, more: float) -> NDArray[np.float64]:
    """(3,) unit direction of a pull, from shares: mostly off the tissue, by mechanics as much along it, so
    that it stretches; a poke goes into it; 0 where the tool only touches.
    """
    if cfg.mechanics in ("poke", "breathe"):
        return np.array([0.0, 0.0, -1.0 if cfg.mechanics == "poke" else 0.0])
    away = np.array([side * (less if cfg.mechanics == "none" else more), along, more])
    return away / np.linalg.norm(away)


def _loads(cfg: PhantomConfig, anatomy: Anatomy, pulls: list[Pull]) -> tuple[Load, ...]:
    """What moves the tissue by mechanics."""
    if cfg.mechanics == "none":
        return ()
    if cfg.mechanics == "breathe":
        rise = cfg.breathing_mm
        sheet = solve_sheet(anatomy, pulls[0].center, np.zeros(3), rise, rise * GROWTH_PER_MM)
        return (Load(sheet, lambda phase: float(0.5 - 0.5 * np.cos(_breath(phase, cfg.frames)))),)
    return tuple(Load(solve_sheet(anatomy, pull.center, pull.vector, 0.0, 0.0), pull.strength) for pull in pulls)
