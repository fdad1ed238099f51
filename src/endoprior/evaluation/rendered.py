"""What is scored: anything that renders the frames of a sequence, a scene or another program's images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from ..core.types import Camera
from ..data import FrameSequence, Split
from ..model.scene import RenderedScene
from ..system.memory import BoundedCache, cache_bytes
from .metrics import ScoreUnavailable, to_uint8

NO_DEPTH = "needs depth, which was not rendered for every frame"
Rendering = tuple[NDArray[np.float32], NDArray[np.float32] | None]
"""Color (H, W, 3) in [0, 1], and depth (H, W) in mm as z, 0 where nothing is; None for no depth."""


class Reconstruction(Protocol):
    """The result of a method, as it is scored. `SceneFrames` makes one of a scene.

    It may have an attribute `provenance`, a dict in JSON's types, which is saved in `metrics.json` beside the scores.
    """

    def render(self, index: int) -> Rendering:
        """Frame `index` of the sequence, 0-based, at its time and from its camera, without tool.

        Raises:
            ScoreUnavailable: there is no such image; scores that need it are skipped with this reason.
        """
        ...


class SceneFrames:
    """A scene, rendered at the times and from the cameras of a sequence."""

    def __init__(self, scene: RenderedScene, sequence: FrameSequence) -> None:
        """Args: scene: what to render. sequence: times and cameras."""
        self.scene, self._sequence = scene, sequence

    def render(self, index: int) -> Rendering:
        """See `Reconstruction.render`."""
        frame = self._sequence.frame(index)
        out = self.scene.render(frame.time, frame.camera)
        return out.color.cpu().numpy(), out.depth.cpu().numpy()


@dataclass(frozen=True)
class RenderedFrame:
    """One rendered frame."""

    color: NDArray[np.float32] | None
    """(H, W, 3) in [0, 1], not rounded; kept for frames of the split only."""
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3) rounded to 8 bits: what the published protocol scores."""
    rendered_depth: NDArray[np.float32] | None
    """(H, W) z, mm; None if there is none."""

    @property
    def rgb(self) -> NDArray[np.float32]:
        """(H, W, 3) `rgb_u8` in [0, 1]."""
        return self.rgb_u8 / np.float32(255)

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) z, mm; of a scene the sum of weight * z.

        Raises:
            ScoreUnavailable: no depth was rendered.
        """
        if self.rendered_depth is None:
            raise ScoreUnavailable(NO_DEPTH)
        return self.rendered_depth

    @property
    def nbytes(self) -> int:
        """Memory it takes."""
        return sum(array.nbytes for array in (self.color, self.rgb_u8, self.rendered_depth) if array is not None)


class RenderedFrames:
    """Rendered frames by index: each is rendered when first asked for, and kept as memory allows."""

    def __init__(self, reconstruction: Reconstruction, sequence: FrameSequence, split: Split) -> None:
        """Args: sequence: size of the frames. split: frames that keep their unrounded color."""
        self._reconstruction, self._sequence = reconstruction, sequence
        self._scored = set(sequence.indices(split))
        self._cache: BoundedCache[RenderedFrame] = BoundedCache(cache_bytes(), lambda rendered: rendered.nbytes)

    def __getitem__(self, index: int) -> RenderedFrame:
        return self._cache.get(index, lambda: self._render(index))

    def _render(self, index: int) -> RenderedFrame:
        color, depth = self._reconstruction.render(index)
        if problem := _problem(color, depth, self._sequence.camera(index)):
            maker = type(self._reconstruction).__name__
            raise InputError(f"{maker}.render({index}): {problem}. Fix: Correct the method that returned it.")
        return RenderedFrame(color if index in self._scored else None, to_uint8(color), depth)


def _problem(color: NDArray, depth: NDArray | None, camera: Camera) -> str:
    """What is wrong with a rendered frame; empty if nothing is."""
    size = (camera.height, camera.width)
    for name, array, shape in (("color", color, (*size, 3)), ("depth", depth, size)):
        if array is not None and (array.shape != shape or array.dtype != np.float32):
            return f"expected {name} of shape {shape} and type float32, got {array.shape} and {array.dtype}"
    if not (color.min() >= 0 and color.max() <= 1):  # NaN fails too
        return f"expected color in [0, 1], got {color.min():g} to {color.max():g}"
    return ""
