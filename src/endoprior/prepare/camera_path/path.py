"""The path of a camera: its poses, how sure they are, and how it moves the image.

How it moves is told by how far its turns and its ways shift the image. A step is split into what turning, moving
sideways and moving ahead do to a plane at the tissue's depth. `T` frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...data.description import MOTION
from .adjust import back_projected
from .shape import DepthShape
from .tracks import TrackingCamera, Tracks

Kind = Literal["static", "turning", "translating", "forward", "backward", "unknown"]
MIN_CAMERA_SHIFT_PX = 1.5
"""A camera whose way shifts the image by less over such a gap (median) is at rest, px at a width of 640."""
OFF_PX, OFF_SHARE = 4.0, 0.5  # a step contradicts the images if its shift is off by more than both, px at 640
WAY = 0.2  # share of the shift that a way causes, below which the camera only turns
AXIAL = 0.7  # share of the length of the way along the optical axis, above which the camera drives along it
CONTRADICTED = 0.3  # share of such steps above which a path is wrong
TURN = 0  # column of `PathMotion.parts_px`
GAP = 5  # frames between two poses that are compared: jitter of single frames is smaller than motion over them
REFINED = "refined with the camera path"  # where the focal length may come from: `sources.lens` of `sequence.json`


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
        if np.median(self.parts_px.max(1)) < MIN_CAMERA_SHIFT_PX * self.px:
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


@dataclass(frozen=True)
class CameraPath:
    """Poses of all frames."""

    camera_to_world: NDArray  # (T, 4, 4), translation in mm; an unexplained frame has the pose of the frame before it
    explained: NDArray[np.bool_]  # (T,) whether the pose is linked to those of the other frames
    depth_scale: NDArray  # (T,) factor that makes the depth of the frame agree with the path; 1 for depth in mm
    method: str = "file"  # where the poses come from
    focal_factor: float = 1.0  # refined focal length, as a multiple of the given one
    translation_std: NDArray | None = None  # (T,) standard deviation of the camera center, mm; NaN where unexplained
    rotation_std: NDArray | None = None  # (T,) standard deviation of the rotation, degrees
    still: NDArray[np.bool_] | None = None  # (T,) whether the pose is a copy, because the camera rests
    breathes: bool = False  # whether periodic motion of the tissue was told apart from the camera's
    notes: list[str] = field(default_factory=list)  # notes for the user, one line each
    motion: PathMotion | None = None  # how the camera moves along it; None without one
    shape: DepthShape | None = None  # how the path changes the shape of relative depth, before its scale
    is_unknown: bool = False  # whether the images do not say how the camera moves: one camera for the explained frames

    @property
    def lost(self) -> list[int]:
        """Frames without a pose of their own."""
        return np.flatnonzero(~self.explained).tolist()

    def sources(self, old: dict[str, str]) -> dict[str, str]:
        """`sources` of `sequence.json` with those of this path."""
        kept = {name: text for name, text in old.items() if name != MOTION}
        motion = {MOTION: self.kind} if self.kind else {}
        return kept | {"poses": self.method} | motion | ({"lens": REFINED} if self.focal_factor != 1 else {})

    @property
    def kind(self) -> str:
        """How the camera moves, in a word of `Kind`; empty without one."""
        return "unknown" if self.is_unknown else self.motion.kind if self.motion else ""

    def record(self) -> dict[str, Any]:
        """What `camera_path.json` holds."""

        def numbers(values: NDArray | None) -> list[float | None]:
            found = np.full(len(self.explained), np.nan) if values is None else values
            return [round(float(v), 5) if np.isfinite(v) else None for v in found]

        return {
            "method": self.method,
            "camera_motion": self.kind,
            "focal_factor": round(self.focal_factor, 5),
            "explained": self.explained.tolist(),
            "still": [] if self.still is None else self.still.tolist(),
            "translation_std_mm": numbers(self.translation_std),
            "rotation_std_degrees": numbers(self.rotation_std),
            "depth_scale": [round(float(v), 6) for v in self.depth_scale],
        }


def path_motion(path: CameraPath, tracks: Tracks, camera: TrackingCamera) -> PathMotion:
    """Measure a path. Args: tracks: whose depths were used. camera: before any refinement of the focal length."""
    camera = camera.with_focal(path.focal_factor)
    count, poses, size = len(path.explained), np.linalg.inv(path.camera_to_world), camera.size
    depth = np.array([np.median(z[z > 0]) if (z > 0).any() else np.nan for z in tracks.depths]) * path.depth_scale
    x, y = np.meshgrid(np.array([1, 3, 5]) * size[0] / 6, np.array([1, 3, 5]) * size[1] / 6)
    grid = np.stack([x.ravel(), y.ravel()], 1)

    def shift(f: int, motion: NDArray) -> float:
        points = back_projected(camera.matrix, np.eye(4), grid, np.full(len(grid), depth[f]))
        there = points @ motion[:3, :3].T + motion[:3, 3]
        pixels = there @ camera.matrix.T
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
    return PathMotion(np.array(shifts), np.array(parts).reshape(-1, 3), axial, ahead, camera.px)
