"""Measure by clicking: pick points on the rendered surface, follow them over time, describe the result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, length_unit
from ..core.types import Camera
from ..model.measures import Measures, measures_of

DISTANCE, AREA, PATH, DISPLACEMENT, STRETCH = "Distance", "Area", "Path length", "Displacement", "Stretch"
POINTS_OF = {DISTANCE: 2, AREA: 64, PATH: 1, DISPLACEMENT: 1, STRETCH: 1}
"""Quantities to measure, and the most points of each: the next click after that begins a new measurement."""
LEAST_POINTS = {DISTANCE: 2, AREA: 3, PATH: 1, DISPLACEMENT: 1, STRETCH: 1}


@dataclass(frozen=True)
class Measurement:
    """Picked points over time."""

    frame: int
    """Frame of the last picked point."""
    paths: NDArray[np.float64]
    """(T, K, 3) positions of the K points in each frame, world axes, mm; NaN where unknown."""
    stretch: NDArray[np.float64] | None = None
    """(T, K) of the surface around the points since frame `since`; None: not computed."""
    since: int = 0
    """Reference frame of displacement and stretch."""

    def ends(self, frame: int, quantity: str = DISTANCE) -> NDArray[np.float64]:
        """The points in `frame`, (K, 3), to draw a line through, closed for an area; (0, 3) where they are unknown."""
        points = self.paths[frame]
        if quantity == AREA and len(points) >= LEAST_POINTS[AREA]:
            points = np.concatenate([points, points[:1]])
        return points if np.isfinite(points).all() else points[:0]

    @cached_property
    def measures(self) -> Measures:
        """Everything that is measured of the points."""
        unknown = np.full(self.paths.shape[:2], np.nan)
        return measures_of(self.paths, unknown if self.stretch is None else self.stretch, self.since, self.frame)

    @property
    def distances(self) -> NDArray[np.float64]:
        """(T,) distance between the first two points in each frame, mm; NaN where unknown, and for a single point."""
        return self.measures.distance

    def curve(self, quantity: str) -> NDArray[np.float64]:
        """(T,) a quantity of `POINTS_OF` in each frame, of the last point if it is one of single points."""
        found = self.measures
        of_points = {PATH: found.path_length, DISPLACEMENT: found.displacement, STRETCH: found.stretch}
        if quantity in of_points:
            return of_points[quantity][:, -1]
        return found.area if quantity == AREA else found.distance


def pick(depth: NDArray, camera: Camera, pixel: tuple[float, float]) -> NDArray[np.float64] | None:
    """The point of the surface behind a pixel.

    Args:
        depth: (H, W) z of the surface, mm; 0 where there is none.
        pixel: (x, y), px.
    Returns:
        (3,) world axes, mm; None outside the image and where there is no surface.
    """
    x, y = (int(np.floor(v)) if np.isfinite(v) else -1 for v in pixel)
    if not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]) or not depth[y, x] > 0:
        return None
    return back_project(np.array(pixel, np.float64), np.float64(depth[y, x]), camera)


def unit_of(quantity: str, relative: bool) -> str:
    """The unit of a quantity; empty for stretch, a ratio. `relative`: lengths have no known unit."""
    return {STRETCH: "", AREA: f"{length_unit(relative)}²"}.get(quantity, length_unit(relative))


def measurement_text(measured: Measurement | None, frame: int, relative: bool, quantity: str = DISTANCE) -> str:
    """The measured quantity in `frame` as text. `relative`: lengths have no known unit."""
    picked = 0 if measured is None else measured.paths.shape[1]
    missing = LEAST_POINTS[quantity] - picked
    if measured is None or missing > 0:
        more = f"{missing} more points" if missing > 1 else "one more point"
        first = "a point" if missing == 1 else f"{missing} points"
        return f"Click {more if picked else first}."
    values = measured.curve(quantity)
    if not np.isfinite(values[frame]):
        crossed = quantity == AREA and np.isfinite(measured.paths[[frame, measured.frame]]).all()
        if crossed:
            return "The edges of the polygon cross, or its corners are on one line."
        if quantity in (PATH, DISPLACEMENT, STRETCH):
            return f"Unknown: the point's way is not known, or it is not on the surface of frame {measured.since}."
        return f"Measured in frame {measured.frame}; the points are unknown in this one."
    digits = 3 if quantity == STRETCH else 2
    text = f"**{values[frame]:.{digits}f} {unit_of(quantity, relative)}**".replace(" **", "**")
    if quantity == PATH:
        return text + f"  \nsince frame 0; {measured.measures.path_length_raw[frame, -1]:.2f} without smoothing"
    since = measured.frame if quantity in (DISTANCE, AREA) else measured.since
    if np.isfinite(values).sum() > 1:
        low, high = np.nanmin(values), np.nanmax(values)
        change = f"{values[frame] - values[since]:+.{digits}f} " if quantity in (DISTANCE, AREA) else ""
        text += f"  \n{change}since frame {since}; {low:.{digits}f} to {high:.{digits}f} over all frames"
    return text
