"""How far carried points may be from the truth: ranges that hold a stated share of the true values.

The error of a point that was picked in the image of a frame has three parts, in camera axes of the frame it is
carried to. They count as independent of each other and of other points', and follow Student's t-distributions, whose
tails are as heavy as those of real errors:

- across the ray, for each of both axes: variance `floor + spread * s^2 + moved * d^2`, px of an image 640 px wide, of
  the disagreement s of the Gaussians that carry the point, and the way d it was carried;
- along the ray where it was picked: `start * n^2`, mm, where n is how far rendered depth is from measured depth;
- along the ray since then: `depth * n^2 + spread * s^2`, s in mm at the point.

Numbers are from phantoms (`bench/uncertainty.py`, docs/scores.md), one row each for points that a frame shows, for
those near the edge of a tool or of the frame, and for those under a tool or outside. They know nothing of an error
that all points share: where depth itself was assumed, or its scale, lengths are as wrong as that. `T` frames, `P`
points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.stats import t as student_t

from ..core.geometry import cells_at, project
from ..core.ranges import evenly_spaced
from ..core.types import Frame
from .carry import CarriedPoints
from .scene import RenderedScene, Scene, SingleScene
from .surface import render_surface

LEVEL = 0.95
"""Share of the true values that a range holds, unless another is asked for."""
NEAR_PX = 4.0
"""Confidence is the probability of an error below this, px of an image 640 px wide."""
WIDTH_PX = 640
CELLS = 32, 40
"""Rows and columns of the small masks that a scene keeps of its frames: a tool hides the points behind it."""
UNKNOWN_NOISE = 0.005
"""Of depth, as a share of it, in scenes from before it was measured."""
NUM_FRAMES = 8
"""Training frames, evenly spaced, whose rendered depth is compared with the measured one."""
WITHIN_ONE_DEVIATION = 0.68
"""Share of normal errors that are less than their standard deviation: far off edges do not count more for being far."""


class Across(NamedTuple):
    """Error across the ray: shares of the variance, see above, and degrees of freedom."""

    floor: float
    spread: float
    moved: float
    freedom: float


class Along(NamedTuple):
    """Error along the ray."""

    depth: float
    spread: float
    freedom: float


SEEN, NEAR, HIDDEN = range(3)
"""Where a point is: shown, less than a cell from what hides it or from the border, hidden."""
ACROSS = Across(6.7e-4, 0.212, 3.4e-5, 2.55), Across(1.3e-4, 0.497, 2.2e-4, 2.01), Across(1e-4, 0.629, 8.8e-4, 1.98)
DRIFT = Along(0.059, 1.88, 5.09), Along(0.059, 4.41, 3.77), Along(0.074, 3.57, 2.76)
"""For each of the three."""
START = Along(0.55, 0.0, 4.29)


def half_width(freedom: float, level: float = LEVEL) -> float:
    """Half of the range that holds a share `level` of a t-distribution of scale 1."""
    return float(student_t.ppf((1 + level) / 2, freedom))


class Part(NamedTuple):
    """One part of the error: the scale of its t-distribution and its degrees of freedom."""

    scale: NDArray[np.float64]  # (T, P) mm
    freedom: NDArray[np.float64]  # (T, P)

    def half_width(self, level: float) -> NDArray[np.float64]:
        """(T, P) half of the range that holds a share `level` of the errors, mm."""
        known, which = np.unique(self.freedom, return_inverse=True)
        reach = np.array([half_width(freedom, level) for freedom in known])
        return np.asarray(self.scale * reach[which.reshape(self.freedom.shape)], np.float64)


@dataclass(frozen=True)
class PointErrors:
    """The error of P points at T times."""

    rays: NDArray[np.float64]
    """(T, P, 3) unit vectors from the camera to the points, world axes."""
    across: Part
    """Of each of the two axes across the ray."""
    start: Part
    """Along the ray, from where the point was picked."""
    drift: Part
    """Along the ray, since then."""
    confidence: NDArray[np.float32]
    """(T, P) probability that the point is less than `NEAR_PX` from the truth in the image."""

    def at(self, times: slice) -> PointErrors:
        """The same points at some of the times."""
        parts = self.across, self.start, self.drift
        across, start, drift = (Part(part.scale[times], part.freedom[times]) for part in parts)
        return PointErrors(self.rays[times], across, start, drift, self.confidence[times])

    def half_width(self, direction: NDArray, level: float = LEVEL, *, since_pick: bool = False) -> NDArray[np.float64]:
        """(T, P) half of the range of positions along a direction (T, P, 3), mm; its length counts as a factor.

        Args:
            since_pick: of the way from where the point was picked: an error of the pick moves both ends.
        """
        along = np.square((direction * self.rays).sum(-1))
        across = np.maximum(np.square(direction).sum(-1) - along, 0)
        depth = np.square(self.drift.half_width(level))
        if not since_pick:
            depth = depth + np.square(self.start.half_width(level))
        return np.asarray(np.sqrt(across * np.square(self.across.half_width(level)) + along * depth), np.float64)

    def along(self, level: float = LEVEL) -> NDArray[np.float64]:
        """(T, P) half of the range of positions along the ray, mm."""
        return np.asarray(np.hypot(self.start.half_width(level), self.drift.half_width(level)), np.float64)


class Sources(NamedTuple):
    """What the errors of carried points are told from."""

    rays: NDArray[np.float64]  # (T, P, 3) unit vectors from the camera to the points, world axes
    mm_per_px: NDArray[np.float64]  # (T, P) mm at the point for each px of an image 640 px wide
    place: NDArray[np.intp]  # (T, P) `SEEN`, `NEAR` or `HIDDEN`
    is_later: NDArray[np.bool_]  # (T, P) not where the point was picked
    spread_px: NDArray[np.float64]  # (T, P) by how much the carriers disagree
    moved_px: NDArray[np.float64]  # (T, P) distance from where the point was picked
    noise_mm: NDArray[np.float64]  # (T, P) deviation of rendered from measured depth
    start_noise_mm: NDArray[np.float64]  # (P,) the same where the point was picked


def sources_of(scene: Scene, carried: CarriedPoints, from_frame: NDArray[np.intp], frames: Sequence[int]) -> Sources:
    """What `point_errors` tells the errors from; arguments as there."""
    positions, shape = carried.positions, carried.spread_px.shape
    rays, mm_per_px, place, noise = np.empty((*shape, 3)), np.empty(shape), np.empty(shape, np.intp), np.empty(shape)
    for i, frame in enumerate(frames):
        camera, there = scene.cameras[frame], positions[i].astype(np.float64)
        pose = camera.world_to_camera
        px, z = project(there, camera)
        rays[i] = there + pose[:3, :3].T @ pose[:3, 3]
        window, own = scene.window_at(frame)
        tissue = None if window.tissue is None else window.tissue[own].numpy()
        place[i] = np.where(z > 0, places_of(px / (camera.width, camera.height), tissue), HIDDEN)
        mm_per_px[i] = np.where(z > 0, z, np.inf) * camera.width / (camera.fx * WIDTH_PX)
        noise[i] = (window.depth_noise or UNKNOWN_NOISE) * np.maximum(z, 0)
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    every = np.arange(shape[1])
    moved_mm = np.linalg.norm(positions - positions[from_frame, every].astype(np.float64), axis=-1)
    moved = np.where(np.isfinite(mm_per_px), moved_mm / mm_per_px, np.inf)  # behind the camera there is no pixel
    is_later = np.arange(shape[0])[:, None] != from_frame
    return Sources(rays, mm_per_px, place, is_later, carried.spread_px, moved, noise, noise[from_frame, every])


def point_errors(
    scene: Scene, carried: CarriedPoints, from_frame: NDArray[np.intp], frames: Sequence[int]
) -> PointErrors:
    """The errors of carried points.

    Args:
        from_frame: (P,) position in `frames` at which each point was picked. frames: T, whose camera sees each time.
    """
    of = sources_of(scene, carried, from_frame, frames)
    with np.errstate(invalid="ignore"):  # behind the camera: infinite
        across = np.choose(of.place, [variance_across(row, of) for row in ACROSS])
        drift = np.choose(of.place, [variance_along(row, of) for row in DRIFT])
        across_mm = np.where(of.is_later, np.sqrt(across) * of.mm_per_px, 0)
    freedom = np.array([row.freedom for row in ACROSS])[of.place]
    start = np.broadcast_to(np.sqrt(START.depth) * of.start_noise_mm, across.shape)
    return PointErrors(
        of.rays,
        Part(across_mm, freedom),
        Part(start, np.full(start.shape, START.freedom)),
        Part(np.where(of.is_later, np.sqrt(drift), 0), np.array([row.freedom for row in DRIFT])[of.place]),
        np.where(of.is_later, near_probability(across, freedom), 1).astype(np.float32),
    )


def variance_across(row: Across, of: Sources) -> NDArray[np.float64]:
    """(T, P) of each axis across the ray, px squared."""
    return row.floor + row.spread * of.spread_px**2 + row.moved * of.moved_px**2


def variance_along(row: Along, of: Sources) -> NDArray[np.float64]:
    """(T, P) along the ray since the pick, mm squared."""
    return row.depth * of.noise_mm**2 + row.spread * (of.spread_px * of.mm_per_px) ** 2


def near_probability(variance_px: NDArray, freedom: NDArray | float) -> NDArray[np.float64]:
    """Probability that an error, of which both axes have a variance, is below `NEAR_PX`; px of an image 640 px wide."""
    with np.errstate(divide="ignore"):
        return np.asarray(1 - (1 + NEAR_PX**2 / (freedom * variance_px)) ** (-freedom / 2), np.float64)


def places_of(places: NDArray, tissue: NDArray[np.uint8] | None) -> NDArray[np.intp]:
    """(P,) `SEEN`, `NEAR` or `HIDDEN` of places (P, 2) in the image, 0 to 1 across and down.

    Args:
        tissue: (I, J) share of each cell of the image that is tissue, 0..255; None: all of it.
    """
    inside = np.asarray(((places >= 0) & (places <= 1)).all(1))
    rows, columns = CELLS if tissue is None else tissue.shape
    shown = np.ones((rows, columns), bool) if tissue is None else tissue >= 128
    around = np.asarray(minimum_filter(shown, 3, mode="constant", cval=0), bool)
    x, y = cells_at(np.where(inside[:, None], places, 0) * (columns, rows), columns, rows)
    return np.where(inside & around[y, x], SEEN, np.where(inside & shown[y, x], NEAR, HIDDEN))


def with_error_sources(scene: RenderedScene, frames: Sequence[Frame]) -> RenderedScene:
    """The scene with what tells the errors of carried points later; radiance fields as given.

    That is the tissue mask of each frame, small, where held-out frames get that of the nearest training frame; and the
    noise of its depth.

    Args:
        frames: those it was trained on.
    """
    if not isinstance(scene, SingleScene):
        return scene
    indices = np.array([frame.index for frame in frames])
    nearest = np.abs(np.arange(len(scene.cameras))[:, None] - indices).argmin(1)
    tissue = np.stack([small_mask(frame) for frame in frames])[nearest]
    chosen = [frames[k] for k in evenly_spaced(len(frames), NUM_FRAMES)]
    return replace(scene, tissue=torch.from_numpy(tissue), depth_noise=depth_noise(scene, chosen))


def small_mask(frame: Frame) -> NDArray[np.uint8]:
    """(I, J) share of each cell of `CELLS` that is tissue, 0..255."""
    share = cv2.resize(frame.tissue_mask.astype(np.float32), CELLS[::-1], interpolation=cv2.INTER_AREA)
    return np.round(255 * share).astype(np.uint8)


def depth_noise(scene: SingleScene, frames: list[Frame]) -> float:
    """How far rendered depth is from measured depth, as a share of it: one standard deviation; 0 without any."""
    errors = [np.zeros(0)]
    for frame in frames:
        rendered = render_surface(scene, frame.time, frame.camera).depth
        both = (rendered > 0) & frame.depth_valid & frame.tissue_mask
        errors.append(np.abs(rendered[both] / frame.depth[both] - 1))
    found = np.concatenate(errors)
    return float(np.quantile(found, WITHIN_ONE_DEVIATION)) if len(found) else 0.0
