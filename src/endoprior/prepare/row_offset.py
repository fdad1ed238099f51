"""The rows of both cameras: how far apart the same points are, and frames in which they agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.checks import input_error
from ..core.ranges import spread
from ..footage.stereo_order import row_offsets_px
from .frame_geometry import FrameGeometry, with_rows_moved
from .video_clip import StereoFrame

COMPARED = 8
"""Number of frames in which the offset is measured."""
FEWEST = 40
"""Number of matching features, over all of them, that an offset needs."""


def with_equal_rows(geometry: FrameGeometry, frames: Sequence[StereoFrame]) -> tuple[FrameGeometry, str]:
    """The geometry that moves the right images so that the rows of both cameras agree, and a note.

    The offset is the median over features of all frames: one number, because it comes from the mounting of the cameras.

    Raises:
        InputError: one camera, or too few features match.
    """
    fix = "Remove `--row-offset auto`."
    pairs = [frame for frame in frames if frame.right is not None]
    if not pairs:
        raise input_error("--row-offset", "two cameras", "one camera", fix)
    pairs = [pairs[i] for i in spread(len(pairs), COMPARED)]
    offsets = _offsets(geometry, pairs)
    if len(offsets) < FEWEST:
        raise input_error("--row-offset", f"{FEWEST} features that both cameras see", str(len(offsets)), fix)
    offset = float(np.median(offsets))
    moved = with_rows_moved(geometry, offset)
    left = float(np.median(np.abs(_offsets(moved, pairs))))
    words = f"the right images are moved {'up' if offset > 0 else 'down'} by {abs(offset):.2f} px"
    return moved, f"{words}: the rows of both cameras were {np.median(np.abs(offsets)):.2f} px apart, now {left:.2f}"


def _offsets(geometry: FrameGeometry, pairs: Sequence[StereoFrame]) -> np.ndarray:
    images = ((geometry.image(pair.left), geometry.image(pair.right, right=True)) for pair in pairs)
    return np.concatenate([row_offsets_px(*both) for both in images])
