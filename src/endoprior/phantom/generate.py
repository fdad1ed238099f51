"""Write a synthetic sequence with ground truth: build the anatomy once, then deform, render and expose each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.writer import SequenceMeta, SequenceWriter
from .config import PhantomConfig
from .instrument import render_tools
from .motion import Motion, build_motion
from .raster import FAR, rasterize, vertex_normals
from .sensor import develop, expose, exposure_gain, stereo_depth, vignette
from .shading import shade
from .surface import MARGIN, Plane, build_anatomy, build_plane, organs_at, soften
from .texture import build_texture, smooth_patches

SUPERSAMPLE = 2
"""Image samples per pixel along each axis."""
_NOTE = "synthetic (endoprior phantom, seed {seed}); truth/tissue is free of tools and of sensor noise"
_LEFT = np.zeros(3, np.float32)


@dataclass(frozen=True)
class Scene:
    """The static parts of one synthetic sequence."""

    cfg: PhantomConfig
    plane: Plane
    motion: Motion
    a: NDArray[np.float64]
    """(MH, MW) plane coordinates of the mesh vertices, mm."""
    b: NDArray[np.float64]
    """(MH, MW) second plane coordinate, mm."""
    height: NDArray[np.float32]
    """(MH, MW) rest height of the vertices, mm."""
    texture: NDArray[np.float32]
    """(TH, TW, 7) material maps."""

    def vertices(self, phase: float) -> NDArray[np.float64]:
        """(MH, MW, 3) mesh in camera axes, mm, at time `phase` in [0, 1]."""
        moved = self.motion.displacement(self.a, self.b, phase)
        return self.plane.lift(self.a + moved[..., 0], self.b + moved[..., 1], self.height + moved[..., 2])


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


def build_scene(cfg: PhantomConfig) -> Scene:
    """Build anatomy, texture and motion of one seed."""
    plane, anatomy = build_plane(cfg), build_anatomy(cfg.seed)
    grown = 1 + 2 * MARGIN
    # A vertex every two pixels, but enough for the shape of the loops.
    across = round(grown * min(max(cfg.width / 2, 160), 480))
    down = round(across * cfg.height / cfg.width)
    grid_v, grid_u = np.meshgrid(np.linspace(0, 1, down), np.linspace(0, 1, across), indexing="ij")
    a, b = plane.coordinates(grid_u, grid_v)
    spacing = float(np.diff(a[down // 2]).mean())
    height = soften(organs_at(anatomy, a, b).height, spacing, 0.7)
    texels = round(grown * 1.8 * cfg.width), round(grown * 1.8 * cfg.height)
    texture = build_texture(plane, anatomy, *texels, cfg.smooth_share)
    return Scene(cfg, plane, build_motion(cfg, plane, anatomy), a, b, height, texture)


def render_view(scene: Scene, vertices: NDArray, phase: float, camera: NDArray[np.float32]) -> RenderedView:
    """Render the mesh `vertices` (MH, MW, 3) and the tools at time `phase` from one camera."""
    cfg, n = scene.cfg, SUPERSAMPLE
    focal, center = n * cfg.focal, (n * cfg.center[0], n * cfg.center[1])
    hits = rasterize(vertices - camera, focal, center, n * cfg.width, n * cfg.height)
    assert hits[..., 2].max() < FAR, "the material ends inside the image"
    tissue = shade(hits, vertex_normals(vertices), scene.texture, scene.plane, camera, focal, center, FAR)
    color, depth = render_tools(scene.motion.tools(phase), np.ascontiguousarray(hits[..., 2]), camera, focal, center)
    is_tool = depth < FAR
    image = np.where(is_tool[..., None], color, tissue)
    size = (cfg.width, cfg.height)
    pooled = [cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (tissue, image, is_tool.astype(np.float32))]
    nearest = np.minimum.reduce([depth[i::n, j::n] for i in range(n) for j in range(n)])
    return RenderedView(*pooled, nearest)


def choose_tracks(scene: Scene) -> NDArray[np.int64]:
    """(P, 2) mesh rows and columns to track: two thirds spread over the first image, the rest near the pulls."""
    cfg = scene.cfg
    rng = np.random.default_rng([cfg.seed, 5])
    vertices = scene.vertices(0.0)
    hits = rasterize(vertices, cfg.focal, cfg.center, cfg.width, cfg.height)
    seen = visible_points(vertices, hits[..., 2], np.zeros(hits.shape[:2], bool), cfg)
    rows, columns = np.nonzero(seen)
    pull = sum(p.weight(scene.a, scene.b) for p in scene.motion.pulls)[rows, columns]
    spread = min(cfg.tracks * 2 // 3, len(rows))
    # np.nonzero lists vertices row by row: even steps through the list cover the image.
    even = np.linspace(0, len(rows) - 1, spread).astype(int) if spread else np.zeros(0, int)
    weight = pull**2
    weight[even] = 0
    extra = min(cfg.tracks - spread, int((weight > 0).sum()))
    near_pulls = rng.choice(len(rows), extra, replace=False, p=weight / weight.sum())
    chosen = np.sort(np.concatenate([even, near_pulls]))
    return np.stack([rows[chosen], columns[chosen]], -1)


def regions(scene: Scene, tracked: NDArray[np.int64]) -> NDArray[np.str_]:
    """(P,) `pulled`: moved by at least half of a pull; else `smooth`: hardly any texture; else `spread`."""
    share = scene.cfg.smooth_share
    pulled = np.max([pull.weight(scene.a, scene.b) for pull in scene.motion.pulls], 0) >= 0.5
    smooth = share > 0 and smooth_patches(scene.a, scene.b, scene.cfg.seed, share) > 0.5
    names = np.where(pulled, "pulled", np.where(smooth, "smooth", "spread"))
    return names[tracked[:, 0], tracked[:, 1]]


def visible_points(
    points: NDArray, z: NDArray[np.float32], tool: NDArray[np.bool_], cfg: PhantomConfig
) -> NDArray[np.bool_]:
    """(...,) True where `points` (..., 3) are in the image and not occluded by tissue `z` (H, W) or `tool`."""
    x = cfg.focal * points[..., 0] / points[..., 2] + cfg.center[0]
    y = cfg.focal * points[..., 1] / points[..., 2] + cfg.center[1]
    inside = (x >= 0) & (x < cfg.width) & (y >= 0) & (y < cfg.height)
    # Depth of the four pixels around the point: on a slope the point may lie behind some of them, never behind all.
    j = np.clip(np.floor(x - 0.5).astype(int), 0, cfg.width - 2)
    i = np.clip(np.floor(y - 0.5).astype(int), 0, cfg.height - 2)
    around = np.stack([z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]])
    covered = tool[np.clip(y, 0, cfg.height - 1).astype(int), np.clip(x, 0, cfg.width - 1).astype(int)]
    # Points next to a silhouette count as occluded: there the four depths differ by more than a slope of 4.
    smooth = np.ptp(around, axis=0) < 0.3 + 4 * points[..., 2] / cfg.focal
    return inside & smooth & (points[..., 2] <= around.max(0) + 0.15) & ~covered


def write_phantom(out: Path, cfg: PhantomConfig, progress: Callable[[int, int], None] | None = None) -> None:
    """Write a synthetic sequence folder with ground truth to `out`.

    Beside the sequence (images, masks, depth, poses, `sequence.json`) it writes `truth/tissue/*.png` (the image
    without tools and without sensor noise), `truth/depth/*.npy` ((H, W) float32 z of the tool-free tissue, mm) and
    `truth/tracks.npz` (`points` (T, P, 3) float32 mm in camera axes, `visible` (T, P) bool; with `cfg.has_regions`
    also `region` (P,)); with `cfg.stereo` also `right/*.png` and `calibration.json`. Tools cast no shadow, so outside
    them an image is the truth plus noise.

    Args:
        out: a new or empty folder; it appears when complete.
        cfg: size, seed, motion, noise.
        progress: called with (frames done, frames) after each frame.
    Raises:
        InputError: `out` is in use.
    """
    (cx, cy), focal = cfg.center, cfg.focal
    meta = SequenceMeta(
        width=cfg.width,
        height=cfg.height,
        fx=focal,
        fy=focal,
        cx=cx,
        cy=cy,
        frames_per_second=cfg.frames_per_second,
        baseline_mm=cfg.baseline_mm,
        depth_source="synthetic stereo",
        note=_NOTE.format(seed=cfg.seed),
    )
    with SequenceWriter(out, meta) as writer:
        scene = build_scene(cfg)
        tracked = choose_tracks(scene)
        lens = vignette(cfg.width, cfg.height)
        right_camera = np.array([cfg.baseline_mm, 0, 0], np.float32)
        # Masks cover the tool's blended rim and one pixel more, as annotators' outlines do.
        rim = np.ones((3, 3), np.uint8)
        points, visible, gain = [], [], None
        for index in range(cfg.frames):
            phase = index / (cfg.frames - 1)
            vertices = scene.vertices(phase)
            view = render_view(scene, vertices, phase, _LEFT)
            gain = exposure_gain(view.tissue) if gain is None else gain
            truth = develop(view.tissue, gain, lens)
            rng = np.random.default_rng([cfg.seed, 6, index])
            image = expose(develop(view.image, gain, lens), cfg.noise, rng)
            mask = cv2.dilate((view.tool_share > 0).astype(np.uint8), rim) > 0
            z = rasterize(vertices, focal, cfg.center, cfg.width, cfg.height)[..., 2]
            measured = stereo_depth(np.minimum(z, view.tool_depth), image, cfg, rng)
            writer.write_image("truth/tissue", np.round(truth).astype(np.uint8))
            writer.write_array(f"truth/depth/{index:06d}.npy", z)
            right = None
            if cfg.stereo:
                other = render_view(scene, vertices, phase, right_camera)
                right = expose(develop(other.image, gain, lens), cfg.noise, np.random.default_rng([cfg.seed, 7, index]))
            writer.add(image, mask, measured, right)
            followed = vertices[tracked[:, 0], tracked[:, 1]]
            points.append(followed)
            visible.append(visible_points(followed, z, mask, cfg))
            if progress is not None:
                progress(index + 1, cfg.frames)
        tracks = {"points": np.stack(points).astype(np.float32), "visible": np.stack(visible)}
        if cfg.has_regions:
            tracks["region"] = regions(scene, tracked)
        writer.write_arrays("truth/tracks.npz", **tracks)
        if cfg.stereo:
            writer.write_json("calibration.json", _calibration(cfg))


def _calibration(cfg: PhantomConfig) -> dict[str, object]:
    """The pair's calibration in the form that `prepare` reads; already rectified."""
    (cx, cy), focal = cfg.center, cfg.focal
    matrix = [[focal, 0, cx], [0, focal, cy], [0, 0, 1]]
    return {
        "layout": "two folders, images/ for the left eye and right/ for the right one, already rectified",
        "width": cfg.width,
        "height": cfg.height,
        "pixel_center": 0.5,
        "K_left": matrix,
        "K_right": matrix,
        "distortion_left": [0, 0, 0, 0, 0],
        "distortion_right": [0, 0, 0, 0, 0],
        "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "T_mm": [-cfg.baseline_mm, 0, 0],
    }
