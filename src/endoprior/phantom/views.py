"""What cameras see of the scene at one time: images in linear light, visible tissue, and truth from other sides.

Side cameras keep only tissue that the endoscope sees in the same frame, as bright as the endoscope sees it: light,
highlights and the shading of the lens stay where they are on the tissue. A model learned from the endoscope's images,
whose color does not depend on the direction, can then be right in every kept pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import AT_ORIGIN, CameraPose
from .config import PhantomConfig
from .instrument_tracing import render_instruments
from .raster import FAR, rasterize
from .scene import PhantomScene, SceneState
from .sensor import develop, vignette_at
from .shading import shade

SUPERSAMPLE = 2
"""Image samples per pixel along each axis."""
TURNS_DEG = {"left20": -20.0, "left10": -10.0, "right10": 10.0, "right20": 20.0}
"""Side cameras turned about a vertical axis through the scene, by name."""
ASIDE_MM = {"aside15": 15.0}
"""Side cameras moved to the right, looking straight on, by name."""


@dataclass(frozen=True)
class RenderedView:
    """The image of one camera at one time, float32."""

    tissue: NDArray
    image: NDArray
    """(H, W, 3) linear radiance without and with tools, and smoke of `cfg.smoke`."""
    tool_share: NDArray
    """(H, W) share of each pixel that is covered by a tool, 0..1."""
    tool_depth: NDArray
    """(H, W) z of the nearest tool sample, mm; FAR where there is none."""


def render_view(scene: PhantomScene, now: SceneState, pose: CameraPose) -> RenderedView:
    """Render the tissue and the tools of one moment from one camera."""
    n = SUPERSAMPLE
    tissue, z = _tissue_samples(scene, now, pose, pose.center)
    assert z.max() < FAR, "the material ends inside the image"
    focal, center = _sample_grid(scene.cfg)
    tools = now.tools, scene.instruments, scene.cfg.seed
    color, depth = render_instruments(*tools, tissue, z, pose.center, focal, center, now.endoscope)
    is_tool = depth < FAR
    light = np.array(scene.look.light, np.float32)
    image = np.where(is_tool[..., None], color, tissue) * light
    tissue = tissue * light
    if scene.smoke is not None:
        if not scene.cfg.smoke:  # smoke as a kind of tissue belongs to the truth
            tissue = scene.smoke.veiled(tissue, z, now.phase, pose, focal, center)
        image = scene.smoke.veiled(image, np.minimum(z, depth), now.phase, pose, focal, center)
    nearest = np.minimum.reduce([depth[i::n, j::n] for i in range(n) for j in range(n)])
    share = pooled(is_tool.astype(np.float32), scene.cfg)
    return RenderedView(pooled(tissue, scene.cfg), pooled(image, scene.cfg), share, nearest)


def render_tissue(
    scene: PhantomScene, now: SceneState, pose: CameraPose, *, highlights: bool = True
) -> tuple[NDArray, NDArray[np.float32]]:
    """(H, W, 3) radiance towards the endoscope of the tissue that a camera sees, and (H, W) its z, mm, or `FAR`.

    Smoke is left out: it is not on the tissue.
    """
    samples, _ = _tissue_samples(scene, now, pose, AT_ORIGIN.center, highlights)
    radiance = pooled(samples * np.array(scene.look.light, np.float32), scene.cfg)
    return radiance, pixel_hits(pose.to_camera(now.vertices), scene.cfg)[..., 2]


def _tissue_samples(
    scene: PhantomScene, now: SceneState, pose: CameraPose, viewer: NDArray[np.float64], highlights: bool = True
) -> tuple[NDArray, NDArray]:
    """(SH, SW, 3) radiance towards `viewer` (3,) and (SH, SW) z of every sample."""
    hits, focal, center = sample_hits(pose.to_camera(now.vertices), scene.cfg)
    axes = scene.plane.axes[:2] @ now.endoscope.rotation
    radiance = shade(hits, now.normals, scene.texture, axes, pose, viewer, focal, center, highlights=highlights)
    return radiance, np.ascontiguousarray(hits[..., 2])


def _sample_grid(cfg: PhantomConfig) -> tuple[float, tuple[float, float]]:
    """Focal length and principal point, px of the samples."""
    return SUPERSAMPLE * cfg.focal, (SUPERSAMPLE * cfg.center[0], SUPERSAMPLE * cfg.center[1])


def sample_hits(vertices: NDArray, cfg: PhantomConfig) -> tuple[NDArray[np.float32], float, tuple[float, float]]:
    """(SH, SW, 3) what `rasterize` finds at the samples of a camera; focal length and principal point, px of these."""
    focal, center = _sample_grid(cfg)
    return rasterize(vertices, focal, center, SUPERSAMPLE * cfg.width, SUPERSAMPLE * cfg.height), focal, center


def pooled(samples: NDArray, cfg: PhantomConfig) -> NDArray:
    """(H, W, ...) means over the samples of each pixel."""
    return cv2.resize(samples, (cfg.width, cfg.height), interpolation=cv2.INTER_AREA)


def pixel_hits(vertices: NDArray, cfg: PhantomConfig) -> NDArray[np.float32]:
    """(H, W, 3) what `rasterize` finds at the pixels of a camera that sees `vertices` (MH, MW, 3), mm."""
    return rasterize(vertices, cfg.focal, cfg.center, cfg.width, cfg.height)


def visible_points(points: NDArray, z: NDArray, tool: NDArray[np.bool_], cfg: PhantomConfig) -> NDArray[np.bool_]:
    """(...,) True where `points` (..., 3) are in the image and not occluded by tissue `z` (H, W) or `tool` (H, W)."""
    ahead = points[..., 2] > 0
    depth = np.where(ahead, points[..., 2], np.inf)
    x = cfg.focal * points[..., 0] / depth + cfg.center[0]
    y = cfg.focal * points[..., 1] / depth + cfg.center[1]
    inside = ahead & (x >= 0) & (x < cfg.width) & (y >= 0) & (y < cfg.height)
    # Depth of the four pixels around the point: on a slope the point may lie behind some of them, never behind all.
    j = np.clip(np.floor(x - 0.5).astype(int), 0, cfg.width - 2)
    i = np.clip(np.floor(y - 0.5).astype(int), 0, cfg.height - 2)
    around = np.stack([z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]])
    covered = tool[np.clip(y, 0, cfg.height - 1).astype(int), np.clip(x, 0, cfg.width - 1).astype(int)]
    # Points next to a silhouette count as occluded: there the four depths differ by more than a slope of 4.
    smooth = np.ptp(around, axis=0) < 0.3 + 4 * points[..., 2] / cfg.focal
    return inside & smooth & (points[..., 2] <= around.max(0) + 0.15) & ~covered


def shown_elsewhere(hits: NDArray[np.float32], seen: NDArray[np.bool_], tool: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) True behind the `tool` (H, W) where the tissue at `hits` (H, W, 3) is `seen` (MH, MW), at another time."""
    rows, columns = seen.shape
    row = np.round(hits[..., 1] * (rows - 1)).astype(int)
    column = np.round(hits[..., 0] * (columns - 1)).astype(int)
    return tool & seen[row, column]


def side_cameras(pivot_mm: float) -> dict[str, CameraPose]:
    """The side cameras by name; they turn about an axis `pivot_mm` from the endoscope, on its optical axis."""
    pivot = np.array([0.0, 0.0, pivot_mm])
    poses = {}
    for name, degrees in TURNS_DEG.items():
        # A camera to the right looks back to the left: its z axis turns towards -x.
        angle = -np.deg2rad(degrees)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        poses[name] = CameraPose(pivot - turn @ pivot, turn)
    return poses | {name: CameraPose.moved_right(mm) for name, mm in ASIDE_MM.items()}


def side_view(
    scene: PhantomScene, now: SceneState, pose: CameraPose, front_z: NDArray, tool: NDArray[np.bool_], gain: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """(H, W, 3) noise-free image of one side camera and (H, W) its depth, mm; 0 where the endoscope sees no tissue.

    Args:
        front_z: (H, W) mm and tool: (H, W) mask, as the endoscope sees them.
        gain: exposure.
    """
    cfg = scene.cfg
    radiance, z = render_tissue(scene, now, pose)
    y, x = np.mgrid[: cfg.height, : cfg.width].astype(np.float64) + 0.5
    rays = np.stack([(x - cfg.center[0]) / cfg.focal, (y - cfg.center[1]) / cfg.focal, np.ones_like(x)], -1)
    points = (rays * np.where(z < FAR, z, 1)[..., None]) @ pose.rotation.T + pose.center
    seen = (z < FAR) & (points[..., 2] > 0)
    points[~seen] = (0, 0, 1)
    seen &= visible_points(points, front_z, tool, cfg)
    across = cfg.focal * points[..., 0] / points[..., 2] + cfg.center[0]
    down = cfg.focal * points[..., 1] / points[..., 2] + cfg.center[1]
    lens = vignette_at(across / cfg.width, down / cfg.height).astype(np.float32)[..., None]
    picture = np.round(develop(radiance, gain, lens)).astype(np.uint8)
    # Samples of a pixel on a silhouette see different surfaces.
    inner = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    return np.where(inner[..., None], picture, 0), np.where(inner, z, 0).astype(np.float32)
