"""Clicked points: what is measured of them over time, and the tracks that are drawn through them.

`T` frames, `K` points. All methods run in the rendering thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, length_unit
from ..core.types import Camera
from ..model.carry import CarriedPoints
from ..model.measures import Measures, measures_of
from ..visualization.measures import measures_csv
from .layers import TRAIL_FRAMES, Lines, concatenated, no_lines, ruler, track_lines
from .panel import AREA, DISPLACEMENT, DISTANCE, PATH, POINTS_OF, STRETCH, Panel
from .viewable import Viewable, ViewSettings

LEAST_POINTS = {DISTANCE: 2, AREA: 3, PATH: 1, DISPLACEMENT: 1, STRETCH: 1}
SURE = 0.5
"""Least confidence of a track that is not drawn faded."""
MOST_PICKED = 100
"""Largest number of clicked points with a track; the next click drops the first."""


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

    def curve(self, quantity: str) -> NDArray[np.float64]:
        """(T,) a quantity of `POINTS_OF` in each frame, of the last point if it is one of single points."""
        found = self.measures
        of_points = {PATH: found.path_length, DISPLACEMENT: found.displacement, STRETCH: found.stretch}
        if quantity in of_points:
            return of_points[quantity][:, -1]
        return found.area if quantity == AREA else found.distance


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
        if quantity == AREA and np.isfinite(measured.paths[[frame, measured.frame]]).all():
            return "The edges of the polygon cross, or its corners are on one line."
        if quantity in (PATH, DISPLACEMENT, STRETCH):
            return f"Unknown: the point's way is not known, or it is not on the surface of frame {measured.since}."
        return f"Measured in frame {measured.frame}; the points are unknown in this one."
    unit = length_unit(relative)
    unit = {STRETCH: "", AREA: f" {unit}²"}.get(quantity, f" {unit}")
    digits = 3 if quantity == STRETCH else 2
    text = f"**{values[frame]:.{digits}f}{unit}**"
    if quantity == PATH:
        return text + f"  \nsince frame 0; {measured.measures.path_length_raw[frame, -1]:.2f} without smoothing"
    since = measured.frame if quantity in (DISTANCE, AREA) else measured.since
    if np.isfinite(values).sum() > 1:
        low, high = np.nanmin(values), np.nanmax(values)
        change = f"{values[frame] - values[since]:+.{digits}f} " if quantity in (DISTANCE, AREA) else ""
        text += f"  \n{change}since frame {since}; {low:.{digits}f} to {high:.{digits}f} over all frames"
    return text


class Measuring:
    """The points that are measured, and what the panel shows of them."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self.measured: Measurement | None = None
        self._picked: list[tuple[NDArray, int]] = []
        """Picked points (3,), world axes, mm, and their frames."""

    def clear(self) -> None:
        """Forget all points."""
        self.measured, self._picked = None, []

    def add(self, point: NDArray, viewable: Viewable, settings: ViewSettings) -> None:
        """Add a point, or begin the next measurement with it if this one has all of its points."""
        before = self._picked if len(self._picked) < POINTS_OF[self._panel.quantity.value] else []
        self._picked = [*before, (point, settings.frame)]
        self.update(viewable, settings)

    def update(self, viewable: Viewable, settings: ViewSettings) -> None:
        """Follow the points over time; stretch, which takes a while, only if it is chosen."""
        self._measure(viewable, settings.since, self._panel.quantity.value == STRETCH)

    def _measure(self, viewable: Viewable, since: int, with_stretch: bool) -> CarriedPoints | None:
        if not self._picked:
            return None
        points, frames = zip(*self._picked, strict=True)
        followed = viewable.follow(np.stack(points), list(frames))
        paths = followed.positions.astype(np.float64)
        stretch = viewable.stretch(paths[since], since) if with_stretch else None
        self.measured = Measurement(frames[-1], paths, stretch, since)
        return followed

    def table(self, viewable: Viewable, settings: ViewSettings) -> str | None:
        """Every measure of the points as CSV; None if there are none."""
        followed = self._measure(viewable, settings.since, with_stretch=True)
        if followed is None:
            return None
        unit = length_unit(viewable.relative)
        return measures_csv(self.measured.measures, viewable.frames_per_second, unit, followed.confidence)

    def lines(self, frame: int) -> Lines:
        """The line through the points."""
        return ruler(self.measured.ends(frame, self._panel.quantity.value)) if self.measured else no_lines()

    def show(self, viewable: Viewable, frame: int) -> None:
        """Update the text and the chart of the panel."""
        controls, quantity = self._panel, self._panel.quantity.value
        shown = self.measured or controls.measure.value
        text = measurement_text(self.measured, frame, viewable.relative, quantity) if shown else ""
        controls.distance.content = text
        controls.show_curve(self.measured.curve(quantity) if self.measured else np.zeros(0))


class DrawnTracks:
    """The tracks on one viewable: a grid of points of the first frame, and points that were clicked in any frame."""

    def __init__(self, viewable: Viewable) -> None:
        self._viewable = viewable
        self._grid: CarriedPoints | None = None
        self.picked: list[CarriedPoints] = []
        """One point each."""

    def pick(self, point: NDArray, frame: int) -> None:
        """Start a track at a clicked point (3,), world axes, mm."""
        self.picked = [*self.picked, self._viewable.follow(point[None], [frame])][-MOST_PICKED:]

    def clear(self) -> None:
        """Forget the clicked points."""
        self.picked = []

    def lines(self, frame: int, with_grid: bool) -> Lines:
        """What to draw in `frame`: the clicked points, and the grid if it is wanted."""
        lines = no_lines()
        if with_grid:
            self._grid = self._grid or self._viewable.tracks()
            lines = self._lines_of(self._grid.positions, self._grid.confidence, frame)
        if self.picked:
            positions = np.concatenate([one.positions for one in self.picked], 1)
            confidence = np.concatenate([one.confidence for one in self.picked], 1)
            lines = concatenated(lines, self._lines_of(positions, confidence, frame))
        return lines

    def _lines_of(self, positions: NDArray, confidence: NDArray, frame: int) -> Lines:
        sure = confidence >= SURE
        for i in range(max(frame - TRAIL_FRAMES, 0), frame + 1):
            sure[i] &= self._viewable.shows(positions[i], i)
        return track_lines(positions, frame, sure) if positions.shape[1] else no_lines()
