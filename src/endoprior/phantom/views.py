"""What a camera sees of the scene at one time: tissue and tools, in linear light."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig
from .eye import STILL, Eye
from .instrument import render_tools
from .instrument_tracing import render_instruments
from .raster import FAR, rasterize
from .scene import Moment, Scene
from .shading import shade

SUPERSAMPLE = 2
"""Image samples per pixel along each axis."""
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class RenderedView:
    """The image of one camera at one time."""

    tissue: NDArray[np.float32]
    """(H, W, 3) linear radiance without tools."""
    image: NDArray[np.float32]
    """(H, W, 3) linear radiance with tools."""
    tool_share: NDArray[np.float32]
    """(H, W) share of each pixel that is covered by a tool, 0..1."""
    tool_depth: NDArray[np.float32]
    """(H, W) z of the nearest tool sample, mm; FAR where there is none."""


def render_view(scene: Scene, now: Moment, eye: Eye) -> RenderedView:
    """Render the tissue and the tools of one moment from one camera."""
    n = SUPERSAMPLE
    tissue, z = _tissue_samples(scene, now, eye, eye.center)
    assert z.max() < FAR, "the material ends inside the image"
    color, depth = _tool_samples(scene, now, eye, tissue, z)
    is_tool = depth < FAR
    image = np.where(is_tool[..., None], color, tissue)
    tissue, image = _lit(tissue, scene), _lit(image, scene)
    if scene.smoke is not None:
        focal, center = _sample_grid(scene.cfg)
        tissue = scene.smoke.veiled(tissue, z, now.phase, eye, focal, center)
        image = scene.smoke.veiled(image, np.minimum(z, depth), now.phase, eye, focal, center)
    pooled = [_pooled(x, scene.cfg) for x in (tissue, image, is_tool.astype(np.float32))]
    nearest = np.minimum.reduce([depth[i::n, j::n] for i in range(n) for j in range(n)])
    return RenderedView(*pooled, nearest)


def render_tissue(scene: Scene, now: Moment, eye: Eye) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a side camera sees of the tissue: (H, W, 3) its radiance towards the endoscope, and (H, W) its z, mm.

    z is `FAR` where there is no tissue. Smoke is left out: it is not on the tissue.
    """
    cfg = scene.cfg
    z = rasterize(eye.sees(now.vertices), cfg.focal, cfg.center, cfg.width, cfg.height)[..., 2]
    return _pooled(_lit(_tissue_samples(scene, now, eye, STILL.center)[0], scene), cfg), z


def _tissue_samples(
    scene: Scene, now: Moment, eye: Eye, viewer: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(SH, SW, 3) radiance and (SH, SW) z of every sample."""
    cfg, n = scene.cfg, SUPERSAMPLE
    focal, center = _sample_grid(cfg)
    hits = rasterize(eye.sees(now.vertices), focal, center, n * cfg.width, n * cfg.height)
    axes = scene.plane.axes[:2] @ now.endoscope.turn
    radiance = shade(hits, now.normals, scene.texture, axes, eye, viewer, focal, center, FAR)
    return radiance, np.ascontiguousarray(hits[..., 2])


def _tool_samples(
    scene: Scene, now: Moment, eye: Eye, tissue: NDArray[np.float32], z: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(SH, SW, 3) radiance and (SH, SW) z of the tools in front of the tissue; FAR where there is none."""
    center = eye.center.astype(np.float32)
    where = center, *_sample_grid(scene.cfg), now.endoscope
    if scene.instruments is None:
        return render_tools(now.tools, z, *where)
    return render_instruments(now.tools, scene.instruments, scene.cfg.seed, tissue, z, *where)


def _lit(radiance: NDArray[np.float32], scene: Scene) -> NDArray[np.float32]:
    """The radiance (SH, SW, 3) under light of the scene's color."""
    return radiance if scene.look.light == _WHITE else radiance * np.array(scene.look.light, np.float32)


def _sample_grid(cfg: PhantomConfig) -> tuple[float, tuple[float, float]]:
    """Focal length and principal point, px of the samples."""
    return SUPERSAMPLE * cfg.focal, (SUPERSAMPLE * cfg.center[0], SUPERSAMPLE * cfg.center[1])


def _pooled(samples: NDArray[np.float32], cfg: PhantomConfig) -> NDArray[np.float32]:
    return cv2.resize(samples, (cfg.width, cfg.height), interpolation=cv2.INTER_AREA)
