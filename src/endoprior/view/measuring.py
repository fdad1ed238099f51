"""The measurement of the viewer: keeps the picked points, and shows in the panel what is measured of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import length_unit
from ..visualization.measures import measures_csv
from .line_overlay import Lines, no_lines, ruler
from .measure import POINTS_OF, STRETCH, Measurement, measurement_text
from .panel import Panel
from .view_settings import ViewSettings
from .viewable import Viewable


class Measuring:
    """Picked points and their measurement. All methods run in the rendering thread."""

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

    def update(self, viewable: Viewable, settings: ViewSettings, everything: bool = False) -> None:
        """Follow the points over time; stretch, which takes a while, only if it is chosen or with `everything`."""
        if not self._picked:
            return
        points, frames = zip(*self._picked, strict=True)
        paths, since = viewable.carry(np.stack(points), list(frames)), settings.since
        stretched = everything or self._panel.quantity.value == STRETCH
        self.measured = Measurement(
            frames[-1], paths, viewable.stretch(paths[since], since) if stretched else None, since
        )

    def table(self, viewable: Viewable, settings: ViewSettings) -> str | None:
        """Every measure of the points as CSV; None if there are none."""
        self.update(viewable, settings, everything=True)
        if self.measured is None:
            return None
        points, frames = zip(*self._picked, strict=True)
        confidence = viewable.follow(np.stack(points), list(frames)).confidence
        unit = length_unit(viewable.relative)
        return measures_csv(self.measured.measures, viewable.frames_per_second, unit, confidence)

    def lines(self, frame: int) -> Lines:
        """The line through the points."""
        return ruler(self.measured.ends(frame, self._panel.quantity.value)) if self.measured else no_lines()

    def show(self, viewable: Viewable, frame: int) -> None:
        """Update the text and the chart of the panel."""
        controls, quantity, relative = self._panel, self._panel.quantity.value, viewable.relative
        shown = self.measured or controls.measure.value
        text = measurement_text(self.measured, frame, relative, quantity) if shown else ""
        controls.distance.content = text
        controls.show_curve(self.measured.curve(quantity) if self.measured else np.zeros(0))
