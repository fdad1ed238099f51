"""The tracks that the viewer draws: a grid of points of the first frame, and points that were clicked in any frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.carry import CarriedPoints
from .line_overlay import TRAIL_FRAMES, Lines, concatenated, no_lines, track_lines
from .viewable import Viewable

SURE = 0.5
"""Least confidence of a track that is not drawn faded."""
MOST_PICKED = 100
"""Largest number of clicked points; the next click drops the first."""


class DrawnTracks:
    """Tracks on one viewable."""

    def __init__(self, viewable: Viewable) -> None:
        """Start without clicked points."""
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
            if self._grid is None:
                self._grid = self._viewable.tracks()
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
