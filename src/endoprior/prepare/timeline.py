"""When the images of a video are shown: its usual time step, and times that go on where the file starts again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

RATES = (0.01, 100_000.0)
"""Plausible frame rates, 1/s."""
USUAL_RATE = 25.0
"""Frame rate of a file without times, 1/s."""
NEAR = 0.25
"""Time steps that differ from the median by less than this share are the usual step, up to rounding of the file."""
SAME_RATE = 0.01
"""A stated rate that differs from the measured one by less than this share is its exact value."""
Item = TypeVar("Item")


@dataclass
class Timeline:
    """Times that only increase, and counts of where those of the file do not."""

    step: float
    """Usual time between two images, s."""
    restarts: int = 0
    """How often time starts again, as where two recordings were joined."""
    misplaced: int = 0
    """Images whose time is not after that of the image before, while the next one is in order again."""

    def along(self, images: Iterable[tuple[Item, float | None]]) -> Iterator[tuple[Item, float]]:
        """The images and their times, s. A misplaced image keeps its time; all others are later than those before.

        Args:
            images: in the order in which they are shown, with the times of the file; None where it has none.
        """
        shift, last = 0.0, None
        for (image, time), following in _with_next(images):
            now = (0.0 if last is None else last + self.step) if time is None else time + shift
            if time is not None and last is not None and now <= last:
                if following is not None and following + shift > last:
                    self.misplaced += 1
                    yield image, now
                    continue
                self.restarts += 1
                now = last + self.step
                shift = now - time
            yield image, now
            last = now


def _with_next(images: Iterable[tuple[Item, float | None]]) -> Iterator[tuple[tuple[Item, float | None], float | None]]:
    """Each entry, and the time of the next one."""
    before = None
    for entry in images:
        if before is not None:
            yield before, entry[1]
        before = entry
    if before is not None:
        yield before, None


def usual_rate(times: Sequence[float], stated: Sequence[float]) -> float:
    """Frame rate of a video, 1/s: that of most of its time steps. Pauses do not change it.

    Args:
        times: of the images in the order of the file, s; they may start again.
        stated: rates that the file states, the best one first; they may be averages over pauses, or a clock.
    """
    usable = [rate for rate in stated if RATES[0] <= rate <= RATES[1]]
    steps = np.diff(np.asarray(times, np.float64))
    steps = steps[steps > 1 / RATES[1]]
    if not len(steps):
        return usable[0] if usable else USUAL_RATE
    middle = float(np.median(steps))
    rate = 1 / float(steps[np.abs(steps - middle) < NEAR * middle].mean())
    exact = [each for each in usable if abs(each / rate - 1) < SAME_RATE]
    return exact[0] if exact else max(rate, RATES[0])
