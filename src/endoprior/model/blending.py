"""Pictures of Gaussians at one time, of one window of a scene or mixed from those of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import reduce

import torch

from .. import render
from ..core.types import Camera, RenderedView, Splats

Background = tuple[float, float, float]
"""Color in [0, 1]."""
BLACK = (0.0, 0.0, 0.0)


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
