"""Which frames saw the tissue. All else that a scene shows is carried from another time, or a guess.

`N` Gaussians, `F` frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame
from .scene import Scene
from .surface import project_visible, render_surface


@dataclass(frozen=True)
class Support:
    """Which Gaussians each frame shows: on tissue, in the image, and not behind other tissue."""

    seen: NDArray[np.bool_]
    """(N, F)."""
    times: NDArray[np.float64]
    """(F,) in [0, 1)."""

    @property
    def num_frames(self) -> NDArray[np.int64]:
        """(N,) frames that show it; 0: a guess."""
        return self.seen.sum(1)

    def gap(self, time: float) -> NDArray[np.float64]:
        """(N,) distance from `time` to the nearest time at which a frame shows it; infinite for a guess."""
        distance = np.where(self.seen, np.abs(self.times - time), np.inf)
        return distance.min(1, initial=np.inf)


def support_of(scene: Scene, frames: Iterable[Frame]) -> Support:
    """The support of a scene in `frames`: those it was trained on."""
    seen, times = [], []
    for frame in frames:
        means = scene.at(frame.time).means.cpu().numpy()
        surface = render_surface(scene, frame.time, frame.camera)
        seen.append(project_visible(means, surface, frame.tissue_mask)[1])
        times.append(frame.time)
    none = np.zeros((len(scene), 0), bool)
    return Support(np.stack(seen, 1) if seen else none, np.array(times, np.float64))
