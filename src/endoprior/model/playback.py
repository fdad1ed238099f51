"""Pictures of Gaussians at one time: those of several windows are mixed; those of frames are played from a cache.

Frames are deformed once and cached, so that rendering one again needs no deformation.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import fields
from functools import reduce
from typing import TYPE_CHECKING

import torch

from .. import render
from ..core.types import Camera, RenderedView, Splats

if TYPE_CHECKING:
    from .scene import Scene

Background = tuple[float, float, float]
"""Color in [0, 1]."""
BLACK = (0.0, 0.0, 0.0)

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


def rendered(
    parts: Sequence[tuple[Splats, float]], camera: Camera, backend: render.Backend, background: Background = BLACK
) -> RenderedView:
    """The weighted mean of what `camera` sees of each of some Gaussians."""
    rasterize, behind = render.load(backend), parts[0][0].means.new_tensor(background)
    return mixed([(rasterize(splats, camera, background=behind).view, weight) for splats, weight in parts])


def rendered_many(
    parts: Sequence[Sequence[tuple[Splats, float]]],
    cameras: Sequence[Camera],
    backend: render.Backend,
    background: Background = BLACK,
) -> list[RenderedView]:
    """`rendered` for several cameras, in one call where the backend can."""
    every = [(splats, camera) for some, camera in zip(parts, cameras, strict=True) for splats, _ in some]
    behind = every[0][0].means.new_tensor(background)
    outputs = render.load_many(backend)([s for s, _ in every], [camera for _, camera in every], background=behind)
    views = iter(out.view for out in outputs)
    return [mixed([(next(views), weight) for _, weight in some]) for some in parts]


def mixed(views: Sequence[tuple[RenderedView, float]]) -> RenderedView:
    """The weighted mean of pictures of one size; the weights add up to 1."""
    if len(views) == 1:
        return views[0][0]
    names = [field.name for field in fields(RenderedView)]
    parts = ([weight * getattr(view, name) for view, weight in views] for name in names)
    return RenderedView(*(reduce(torch.add, part) for part in parts))


def faded(splats: Splats, weight: float) -> Splats:
    """`splats` with their optical depth multiplied by `weight` in (0, 1]."""
    if weight == 1:
        return splats
    return Splats(**splats.tensors | {"opacities": 1 - (1 - splats.opacities) ** weight})


def joined(parts: Sequence[Splats]) -> Splats:
    """The Gaussians of all `parts`, which have the same tensors."""
    if len(parts) == 1:
        return parts[0]
    names = [field.name for field in fields(Splats) if getattr(parts[0], field.name) is not None]
    return Splats(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
