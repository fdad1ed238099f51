"""`prepare.json` in a prepared folder: from what, and with which options, `prepare` made it.

It names files of the user. `check` repeats what is particular about the video; points of a video find their frame.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.config_io import from_dict
from ..core.options import Options
from ..system.atomic import write_json
from .files import read_json

RECORD = "prepare.json"
STEPS, NEAR_PX = 40, 0.5
"""Steps to find a source point in the frame, and how near it they end, px, unless it lies outside of the frame."""


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


def read_record(folder: Path) -> PrepareRecord | None:
    """The record of a folder; None if it has none.

    Raises:
        InputError: the file is damaged.
    """
    file, fix = folder / RECORD, "remove it, or prepare the folder again."
    if not file.exists():
        return None
    try:
        record = from_dict(PrepareRecord, read_json(file, fix), "record")
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    widths = {len(row) for row in record.source_px}
    pairs = all(len(point) == 2 for row in record.source_px for point in row)
    if not pairs or len(widths) != 1 or min(len(record.source_px), *widths, 2) < 2 or min(record.source_size) < 1:
        raise input_error(file, "source_px as rows of x, y", "another shape", fix)
    return record
