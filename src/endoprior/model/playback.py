"""Frames of a scene of Gaussians, which are deformed once and cached: rendering one again needs no deformation."""

from __future__ import annotations

import torch

from ..core.types import Camera, RenderedView, Splats
from ..system.memory import BoundedCache
from .scene import Scene, faded, joined, render_parts, render_parts_many

DEFAULT_MAX_BYTES = 1 << 30
"""Memory that cached frames may take; about 2 MB a frame for 40,000 Gaussians of one color each."""


class Playback:
    """Frames of a scene by index, cached once deformed; the least recently used ones are dropped when memory is full.

    Images are bit-identical to those of `Scene.render`. For a time between frames use the scene itself.
    """

    def __init__(self, scene: Scene, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """Args: max_bytes: for all cached frames together; at least one frame is always cached."""
        self.scene = scene
        self._cache: BoundedCache[list[tuple[Splats, float]]] = BoundedCache(max_bytes, _num_bytes)

    def __len__(self) -> int:
        return len(self.scene.cameras)

    def splats(self, index: int) -> Splats:
        """The Gaussians of frame `index`, activated; see `Scene.at`."""
        return joined([faded(splats, weight) for splats, weight in self._parts(index)])

    def _parts(self, index: int) -> list[tuple[Splats, float]]:
        if not 0 <= index < len(self):
            raise IndexError(f"frame must be in 0..{len(self) - 1}; got {index}")
        return self._cache.get(index, lambda: self.scene.parts_at(self.scene.frame_time(index)))

    @torch.no_grad()
    def render(self, index: int, camera: Camera | None = None) -> RenderedView:
        """Render frame `index`, from `camera` or else from its own. See `Scene.render`."""
        scene = self.scene
        if camera is not None and scene.config.data.eyes == "both":  # colors differ from camera to camera
            return scene.render(self.scene.frame_time(index), camera)
        return render_parts(self._parts(index), camera or scene.cameras[index], scene.backend, scene.background)

    @torch.no_grad()
    def render_many(self, indices: list[int]) -> list[RenderedView]:
        """Render several frames from their own cameras. See `Scene.render_many`."""
        cameras = [self.scene.cameras[i] for i in indices]
        parts = [self._parts(i) for i in indices]
        return render_parts_many(parts, cameras, self.scene.backend, self.scene.background)


def _num_bytes(parts: list[tuple[Splats, float]]) -> int:
    return sum(tensor.nbytes for splats, _ in parts for tensor in splats.tensors.values())
