"""Clicked points: what is measured of them over time, and the tracks that are drawn through them.

`T` frames, `K` points. All methods run in the rendering thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import back_project, length_unit
from ..core.types import Camera
from ..model.measures import Measures, measures_of
from ..model.uncertainty import PointErrors
from ..visualization.measures import measures_csv
from .layers import NO_LINES, TRAIL_FRAMES, Lines, ruler, track_lines
from .panel import AREA, DISPLACEMENT, DISTANCE, PATH, POINTS_OF, STRETCH, Panel
from .viewable import FollowedPoints, ViewSettings

if TYPE_CHECKING:
    from .viewable_sequence import Viewable

SURE = 0.5
"""Least confidence of a track that is not drawn faded."""
MAX_PICKED = 100
"""Largest number of clicked points with a track; the next click drops the first."""


def pick(depth: NDArray, camera: Camera, pixel: tuple[float, float]) -> NDArray[np.float64] | None:
    """(3,) point of a surface of `depth` (H, W) behind a pixel (x, y), mm; None outside and where there is none."""
    x, y = (int(np.floor(v)) if np.isfinite(v) else -1 for v in pixel)
    if not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]) or not depth[y, x] > 0:
        return None
    return back_project(np.array(pixel, np.float64), np.array(depth[y, x], np.float64), camera)


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
    errors: PointErrors | None = None
    """Of the points; None: not known."""

    def ends(self, frame: int, quantity: str = DISTANCE) -> NDArray[np.float64]:
        """The points in `frame`, (K, 3), to draw a line through, closed for an area; (0, 3) where they are unknown."""
        points = self.paths[frame]
        if quantity == AREA and len(points) >= POINTS_OF[AREA][0]:
            points = np.concatenate([points, points[:1]])
        return points if np.isfinite(points).all() else points[:0]

    @cached_property
    def measures(self) -> Measures:
        unknown = np.full(self.paths.shape[:2], np.nan)
        stretch = unknown if self.stretch is None else self.stretch
        return measures_of(self.paths, stretch, self.since, self.frame, self.errors)

    def curve(self, quantity: str) -> NDArray[np.float64]:
        """(T,) a quantity of `POINTS_OF` in each frame, of the last point if it is one of single points."""
        found = self.measures
        of_points = {PATH: found.path_length, DISPLACEMENT: found.displacement, STRETCH: found.stretch}
        if quantity in of_points:
            return of_points[quantity][:, -1]
        return found.area if quantity == AREA else found.distance

    def ranges(self, quantity: str) -> NDArray[np.float64]:
        """(T,) half of the range that holds 95 % of the true values of the same; NaN where that is not known."""
        of = self.measures.ranges
        if of is None or quantity not in (DISTANCE, AREA, DISPLACEMENT):
            return np.full(len(self.paths), np.nan)
        return {DISTANCE: of.distance, AREA: of.area, DISPLACEMENT: of.displacement[:, -1]}[quantity]


def measurement_text(measured: Measurement | None, frame: int, relative: bool, quantity: str = DISTANCE) -> str:
    """The measured quantity in `frame` as text. `relative`: lengths have no known unit."""
    picked = 0 if measured is None else measured.paths.shape[1]
    missing = POINTS_OF[quantity][0] - picked
    if measured is None or missing > 0:
        one, several = ("one more point", "more points") if picked else ("a point", "points")
        return f"Click {one if missing == 1 else f'{missing} {several}'}."
    values, of_one = measured.curve(quantity), quantity in (PATH, DISPLACEMENT, STRETCH)
    if not np.isfinite(values[frame]):
        if quantity == AREA and np.isfinite(measured.paths[[frame, measured.frame]]).all():
            return "The edges of the polygon cross, or its corners are on one line."
        if of_one:
            return f"Unknown: the point's way is not known, or it is not on the surface of frame {measured.since}."
        return f"Measured in frame {measured.frame}; the points are unknown in this one."
    unit = length_unit(relative)
    unit = {STRETCH: "", AREA: f" {unit}²"}.get(quantity, f" {unit}")
    digits = 3 if quantity == STRETCH else 2
    half = measured.ranges(quantity)[frame]
    either = f" ± {half:.{digits}f}" if np.isfinite(half) else ""
    text = f"**{values[frame]:.{digits}f}{either}{unit}**" + (" in 95 %" if either else "")
    if quantity == PATH:
        return text + f"  \nsince frame 0; {measured.measures.path_length_raw[frame, -1]:.2f} without smoothing"
    since = measured.since if of_one else measured.frame
    if np.isfinite(values).sum() > 1:
        low, high = np.nanmin(values), np.nanmax(values)
        change = "" if of_one else f"{values[frame] - values[since]:+.{digits}f} "
        text += f"  \n{change}since frame {since}; {low:.{digits}f} to {high:.{digits}f} over all frames"
    return text


class Measuring:
    """The points that are measured, and what the panel shows of them."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self.clear()

    def clear(self) -> None:
        self.measured: Measurement | None = None
        self._picked: list[tuple[NDArray, int]] = []  # (3,) world axes, mm, and its frame

    def add(self, point: NDArray, viewable: Viewable, settings: ViewSettings) -> None:
        """Add a point, or begin the next measurement with it if this one has all of its points."""
        before = self._picked if len(self._picked) < POINTS_OF[self._panel.quantity.value][1] else []
        self._picked = [*before, (point, settings.frame)]
        self.update(viewable, settings)

    def update(self, viewable: Viewable, settings: ViewSettings, everything: bool = False) -> NDArray | None:
        """Follow the points over time; stretch, which takes a while, only if it is chosen, or for `everything`.

        Returns:
            (T, K) confidence in where the points are; None if there are none.
        """
        if not self._picked:
            return None
        points, frames = zip(*self._picked, strict=True)
        followed, since = viewable.follow(np.stack(points), list(frames)), settings.since
        paths = followed.positions.astype(np.float64)
        with_stretch = everything or self._panel.quantity.value == STRETCH
        stretch = viewable.stretch(paths[since], since) if with_stretch else None
        self.measured = Measurement(frames[-1], paths, stretch, since, followed.errors)
        return followed.confidence

    def table(self, viewable: Viewable, settings: ViewSettings) -> str | None:
        """Every measure of the points as CSV; None if there are none."""
        confidence = self.update(viewable, settings, everything=True)
        if confidence is None or self.measured is None:
            return None
        unit = length_unit(viewable.relative)
        return measures_csv(self.measured.measures, viewable.frames_per_second, unit, confidence)

    def save_scale(self, viewable: Viewable) -> None:
        """Write the scale at which the measured distance has the length in the panel, and say so there.

        Raises:
            InputError: no distance in one frame was measured, no length was given, or the folder cannot be written.
        """
        points = [point for point, _ in self._picked]
        save, frames = viewable.save_scale, {frame for _, frame in self._picked}
        if save is None or len(points) != 2 or len(frames) > 1:
            fix = "check Measure by clicking, and click both ends of a known length in one frame."
            raise input_error("Known length, mm", "two points in one frame", f"{len(points)}", fix)
        self._panel.scaled.content = save(np.stack(points), frames.pop(), float(self._panel.known_mm.value))

    def lines(self, frame: int) -> Lines:
        return ruler(self.measured.ends(frame, self._panel.quantity.value)) if self.measured else NO_LINES

    def show(self, viewable: Viewable, frame: int) -> None:
        controls, quantity = self._panel, self._panel.quantity.value
        shown = self.measured or controls.measure.value
        text = measurement_text(self.measured, frame, viewable.relative, quantity) if shown else ""
        controls.distance.content = text
        unknown = np.zeros(0)
        curve, ranges = (
            (self.measured.curve(quantity), self.measured.ranges(quantity)) if self.measured else (unknown, unknown)
        )
        controls.show_curve(curve, ranges)


class DrawnTracks:
    """The tracks on one viewable: a grid of points of the first frame, and points that were clicked in any frame."""

    def __init__(self, viewable: Viewable) -> None:
        self._viewable = viewable
        self.picked: list[FollowedPoints] = []
        """One point each."""

    @cached_property
    def _grid(self) -> FollowedPoints:
        return self._viewable.tracks()

    def pick(self, point: NDArray, frame: int) -> None:
        """Start a track at a clicked point (3,), world axes, mm."""
        self.picked = [*self.picked, self._viewable.follow(point[None], [frame])][-MAX_PICKED:]

    def clear(self) -> None:
        self.picked = []

    def lines(self, frame: int, with_grid: bool) -> Lines:
        """What to draw in `frame`: the grid if it is wanted, and the clicked points."""
        lines = self._lines_of([self._grid], frame) if with_grid else NO_LINES
        return lines + self._lines_of(self.picked, frame)

    def _lines_of(self, points: list[FollowedPoints], frame: int) -> Lines:
        if not any(each.positions.size for each in points):
            return NO_LINES
        positions = np.concatenate([each.positions for each in points], 1)
        sure = np.concatenate([each.confidence for each in points], 1) >= SURE
        for i in range(max(frame - TRAIL_FRAMES, 0), frame + 1):
            sure[i] &= self._viewable.shows(positions[i], i)
        return track_lines(positions, frame, sure)
