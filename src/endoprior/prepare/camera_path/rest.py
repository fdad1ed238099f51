"""When the camera rests: its pose is then copied exactly, so that no jitter of the estimate reaches the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .tracks import Tracks

LOW_PX, HIGH_PX = 0.25, 0.5
"""The camera rests while rigid tissue stays this near to where it was, px of an image 640 px wide; once at rest, it
moves when it is beyond the second value (hysteresis)."""
FEWEST_FRAMES = 8
"""A shorter rest is none: slow motion looks the same."""
RIGID = 0.5
"""Weight of a track that counts as rigid tissue."""
FEWEST_TRACKS = 20


def resting(tracks: Tracks, explained: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Spans (first, last) of frames in which the camera rests: the median rigid track stays where it was at first."""
    spans, first, count = [], 0, len(explained)
    while first < count - 1:
        if not explained[first]:
            first += 1
            continue
        last, limit = first, LOW_PX * tracks.lens.px
        while last + 1 < count and explained[last + 1] and _shift(tracks, first, last + 1) < limit:
            last += 1
            if last - first + 1 >= FEWEST_FRAMES:
                limit = HIGH_PX * tracks.lens.px
        if last - first + 1 >= FEWEST_FRAMES:
            spans.append((first, last))
            first = last
        first += 1
    return spans


def _shift(tracks: Tracks, first: int, other: int) -> float:
    """Median distance, px, of rigid tracks between two frames; inf if too few are seen in both."""
    shared, a, b = np.intersect1d(tracks.ids[first], tracks.ids[other], return_indices=True)
    rigid = (tracks.weight[shared] > RIGID) & ~tracks.keypoint[shared]
    if rigid.sum() < FEWEST_TRACKS:
        return np.inf
    moved = tracks.pixels[other][b[rigid]] - tracks.pixels[first][a[rigid]]
    return float(np.median(np.hypot(*moved.T)))
