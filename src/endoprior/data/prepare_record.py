"""`prepare.json` in a prepared folder: from what, and with which options, `prepare` made it.

`check` uses it to print a complete command. The file names files of the user; nothing else needs it.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.config_io import from_dict
from ..core.shell import Options
from ..system.atomic import write_json
from .files import read_json

RECORD = "prepare.json"
OPTION = re.compile(r"--[a-z][a-z0-9.-]*")
CONTROLS = {"Cc", "Zl", "Zp"}
"""Unicode categories of characters that no path or option has: control characters and line separators."""
SURROGATES = "Cs"
"""That of bytes in a path that are no text: it can be opened, but not printed."""
STEPS, NEAR_PX = 40, 0.5
"""Steps to find a source point in the frame, and how near it they end, px, unless it lies outside of the frame."""
EDGE_POINTS = 65
"""Points along each edge of a rectangle that are taken to the source."""


@dataclass(frozen=True)
class PrepareRecord:
    """How a folder was prepared."""

    video: str
    """Absolute path of the source."""
    options: Options
    """All options that differ from their defaults; paths are absolute."""
    source_size: tuple[int, int]
    """(width, height) of one camera's image in the source, px: what `--crop` and `--blank` count."""
    source_px: tuple[tuple[tuple[float, ...], ...], ...]
    """(R, C, 2) x, y in that image, px, of an even grid over the frame, from corner to corner; R, C at least 2."""
    video_notes: tuple[str, ...] = ()
    """What is particular about the video, and which of its images were not used, one line each."""

    def save(self, folder: Path) -> None:
        """Write `prepare.json`."""
        write_json(folder / RECORD, asdict(self))

    @property
    def categories(self) -> set[str]:
        """Unicode categories of all characters of the video's path, of the options and of the notes."""
        words = [self.video, *self.video_notes, *(word for words in self.options.values() for word in words)]
        return {unicodedata.category(character) for word in words for character in word}

    def crop(self, left: float, top: float, right: float, bottom: float) -> tuple[int, int, int, int]:
        """x, y, width, height of the largest source rectangle that shows nothing outside a part of the frame.

        Args:
            left, top, right, bottom: the part, as shares of the frame's width and height.
        """
        across, down = np.linspace(left, right, EDGE_POINTS), np.linspace(top, bottom, EDGE_POINTS)
        x0 = max(self._source(np.full_like(down, left), down)[:, 0].max(), 0)
        x1 = min(self._source(np.full_like(down, right), down)[:, 0].min(), self.source_size[0])
        y0 = max(self._source(across, np.full_like(across, top))[:, 1].max(), 0)
        y1 = min(self._source(across, np.full_like(across, bottom))[:, 1].min(), self.source_size[1])
        # The grid is exact to 0.1 px: so much of a neighbor is not seen.
        x, y = int(np.ceil(x0 - 0.1)), int(np.ceil(y0 - 0.1))
        return x, y, max(int(x1 + 0.1) - x, 1), max(int(y1 + 0.1) - y, 1)

    def in_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where points of the source lie in the frame: through the rectification, or undistortion, and the crop.

        Args:
            points: (P, 2) x, y in the source, px.
        Returns:
            (P, 2) x, y as shares of the frame's width and height; NaN for points that the frame does not show.
        """
        from scipy.interpolate import RectBivariateSpline  # slow to import, and every reader imports this module

        grid = np.array(self.source_px)
        rows, columns = (np.linspace(0, 1, count) for count in grid.shape[:2])
        order = {"kx": min(3, len(rows) - 1), "ky": min(3, len(columns) - 1)}
        splines = [RectBivariateSpline(rows, columns, grid[..., axis], **order) for axis in (0, 1)]

        def missed(at: NDArray[np.float64]) -> NDArray[np.float64]:
            """(P, 2) from where shares of the frame lie in the source to the points, px."""
            return points - np.stack([spline.ev(at[:, 1], at[:, 0]) for spline in splines], 1)

        at, extent = np.full(points.shape, 0.5), grid[-1, -1] - grid[0, 0]
        for _ in range(STEPS):  # the map is nearly a scaling and a shift
            at = np.clip(at + missed(at) / extent, 0, 1)
        off = np.linalg.norm(missed(at), axis=1)
        return np.where(off[:, None] < NEAR_PX, at, np.nan)

    def _source(self, x: NDArray, y: NDArray) -> NDArray[np.float64]:
        """(K, 2) x, y in the source, px, of K points given as shares of the frame."""
        from scipy.interpolate import RegularGridInterpolator

        grid = np.array(self.source_px)
        axes = [np.linspace(0, 1, count) for count in grid.shape[:2]]
        return RegularGridInterpolator(axes, grid)(np.stack([y, x], 1))


def read_record(folder: Path) -> PrepareRecord | None:
    """The record of a folder; None if it has none.

    Raises:
        InputError: the file is damaged.
    """
    file, fix = folder / RECORD, "remove it, `check` then repeats `prepare` from the frames."
    if not file.exists():
        return None
    try:
        record = from_dict(PrepareRecord, read_json(file, fix), "record")
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    if not all(OPTION.fullmatch(name) for name in record.options) or record.categories & CONTROLS:
        raise input_error(file, "names of options and text in one line", "something else", fix)
    shape = [len(record.source_px), *{len(row) for row in record.source_px}]
    pairs = all(len(point) == 2 for row in record.source_px for point in row)
    if len(shape) != 2 or min(shape) < 2 or not pairs or min(record.source_size) < 1:
        raise input_error(file, "source_px as rows of x, y", "another shape", fix)
    return record
