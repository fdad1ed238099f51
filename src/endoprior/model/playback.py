"""Frames of a scene of Gaussians, which are deformed once and cached: rendering one again needs no deformation."""

from __future__ import annotations

from collections import OrderedDict

import torch

from ..core.types import Camera, RenderedView, Splats
from .blending import faded, joined, rendered, rendered_many
from .scene import Scene

DEFAULT_MAX_BYTES = 1 << 30
"""Memory that cached frames may take; about 2 MB a frame for 40,000 Gaussians of one color each."""


class Playback:
    """Frames of a scene by index, cached once deformed; the least recently used one is dropped when memory is full.

    Images are bit-identical to those of `Scene.render`. For a time between frames use the scene itself.
    """

    def __init__(self, scene: Scene, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """Args: max_bytes: for all cached frames together; at least one frame is always cached."""
        self.scene, self.max_bytes = scene, max_bytes
        self._kept: OrderedDict[int, list[tuple[Splats, float]]] = OrderedDict()

    def __len__(self) -> int:
        return len(self.scene.cameras)

    def splats(self, index: int) -> Splats:
        """The Gaussians of frame `index`, activated; see `Scene.at`."""
        return joined([faded(splats, weight) for splats, weight in self._parts(index)])

    def _parts(self, index: int) -> list[tuple[Splats, float]]:
        if not 0 <= index < len(self):
            raise IndexError(f"frame must be in 0..{len(self) - 1}; got {index}")
        if index not in self._kept:
            parts = self.scene.parts_at(index / len(self))
            capacity = max(self.max_bytes // max(sum(_num_bytes(splats) for splats, _ in parts), 1), 1)
            while len(self._kept) >= capacity:
                self._kept.popitem(last=False)
            self._kept[index] = parts
        self._kept.move_to_end(index)
        return self._kept[index]

    @torch.no_grad()
    def render(self, index: int, camera: Camera | None = None) -> RenderedView:
        """Render frame `index`, from `camera` or else from its own. See `Scene.render`."""
        scene = self.scene
        if camera is not None and scene.config.data.eyes == "both":  # colors differ from camera to camera
            return scene.render(index / len(self), camera)
        return rendered(self._parts(index), camera or scene.cameras[index], scene.backend, scene.background)

    @torch.no_grad()
    def render_many(self, indices: list[int]) -> list[RenderedView]:
        """Render several frames from their own cameras. See `Scene.render_many`."""
        cameras = [self.scene.cameras[i] for i in indices]
        parts = [self._parts(i) for i in indices]
        return rendered_many(parts, cameras, self.scene.backend, self.scene.background)


def _num_bytes(splats: Splats) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in splats.tensors.values())
