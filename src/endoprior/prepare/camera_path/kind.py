"""How a camera moves, told from its path: how far its turns and its ways shift the image, and whether images agree.

A step is split into what turning, moving sideways and moving ahead do to a plane at the tissue's depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .adjust import back_projected
from .tracks import CameraPath, Lens, Tracks

Kind = Literal["static", "turning", "translating", "forward", "backward", "unknown"]
GAP = 5  # frames between two poses that are compared: jitter of single frames is smaller than motion over them
LEAST_PX = 1.5  # a camera whose way shifts the image by less over such a gap (median) is at rest, px at a width of 640
OFF_PX, OFF_SHARE = 4.0, 0.5  # a step contradicts the images if its shift is off by more than both, px at 640
WAY = 0.2  # share of the shift that a way causes, below which the camera only turns
AXIAL = 0.7  # share of the length of the way along the optical axis, above which the camera drives along it
CONTRADICTED = 0.3  # share of such steps above which a path is wrong
TURN = 0  # column of `PathMotion.parts_px`


@dataclass(frozen=True)
class PathMotion:
    """What a path does to the image."""

    shift_px: NDArray  # (T - 1,) mean shift from frame to frame; NaN where one of them is unexplained
    parts_px: NDArray  # (N, 3) shift over `GAP` frames by turning, sideways and along the axis
    axial: float  # length of the way along the optical axis, as a share of the length of all ways, 0..1
    ahead: float  # way along the optical axis, -1..1: its sum as a share of its length, > 0 forward
    px: float  # length of a pixel of an image 640 px wide

    @property
    def shares(self) -> NDArray:
        """(3,) shares of turning, sideways and along the axis."""
        total = self.parts_px.sum(0)
        return total / max(float(total.sum()), 1e-9)

    @property
    def kind(self) -> Kind:
        """Where its way leads; turning if it has hardly any."""
        if not len(self.parts_px):
            return "unknown"
        if np.median(self.parts_px.max(1)) < LEAST_PX * self.px:
            return "static"
        if 1 - self.shares[TURN] < WAY:
            return "turning"
        return "translating" if self.axial < AXIAL else "forward" if self.ahead > 0 else "backward"

    @property
    def drives(self) -> bool:
        """Whether it drives along the optical axis."""
        return self.kind in ("forward", "backward")

    @property
    def reason(self) -> str:
        """The measurements in a few words."""
        words = "turning", "moving sideways", "moving forward" if self.ahead > 0 else "moving back"
        return ", ".join(f"{share:.0%} {word}" for share, word in zip(self.shares, words, strict=True))

    def contradicts(self, measured_px: NDArray) -> bool:
        """Whether the images shift otherwise than the path says. Args: measured_px: (T - 1,) NaN where unknown."""
        known = np.isfinite(self.shift_px) & np.isfinite(measured_px)
        off = np.abs(self.shift_px[known] - measured_px[known])
        wrong = (off > OFF_PX * self.px) & (off > OFF_SHARE * np.maximum(measured_px[known], self.shift_px[known]))
        return bool(known.any() and wrong.mean() > CONTRADICTED)


def path_motion(path: CameraPath, tracks: Tracks, lens: Lens, size: tuple[int, int]) -> PathMotion:
    """Measure a path. Args: tracks: whose depths were used. lens: with the focal length of the path. size: px."""
    count, poses = len(path.explained), np.linalg.inv(path.camera_to_world)
    depth = np.array([np.median(z[z > 0]) if (z > 0).any() else np.nan for z in tracks.depths]) * path.depth_scale
    x, y = np.meshgrid(np.array([1, 3, 5]) * size[0] / 6, np.array([1, 3, 5]) * size[1] / 6)
    grid = np.stack([x.ravel(), y.ravel()], 1)

    def shift(f: int, motion: NDArray) -> float:
        points = back_projected(lens.matrix, np.eye(4), grid, np.full(len(grid), depth[f]))
        there = points @ motion[:3, :3].T + motion[:3, 3]
        pixels = there @ lens.matrix.T
        return float(np.hypot(*(pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-3) - grid).T).mean())

    def between(f: int, gap: int) -> NDArray | None:
        known = f + gap < count and path.explained[f] and path.explained[f + gap] and np.isfinite(depth[f])
        return poses[f + gap] @ np.linalg.inv(poses[f]) if known else None

    shifts = [np.nan if (motion := between(f, 1)) is None else shift(f, motion) for f in range(count - 1)]
    parts, ways = [], []
    for f in range(count):
        if (motion := between(f, GAP)) is None:
            continue
        turn, aside, along = (np.eye(4) for _ in range(3))
        turn[:3, :3], aside[:2, 3], along[2, 3] = motion[:3, :3], motion[:2, 3], motion[2, 3]
        parts.append([shift(f, part) for part in (turn, aside, along)])
        ways.append(-motion[:3, 3])
    way = np.array(ways).reshape(-1, 3)
    along, length = np.abs(way[:, 2]).sum(), np.linalg.norm(way, axis=1).sum()
    axial, ahead = (float(part / max(of, 1e-9)) for part, of in ((along, length), (way[:, 2].sum(), along)))
    return PathMotion(np.array(shifts), np.array(parts).reshape(-1, 3), axial, ahead, lens.px)
