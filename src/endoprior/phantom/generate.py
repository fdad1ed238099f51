"""Write a synthetic sequence with ground truth: build the anatomy once, then deform, render and expose each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.sequence import is_test_frame
from ..data.writer import SequenceMeta, SequenceWriter
from .camera_path import CameraPath, build_camera_path, widened
from .config import PhantomConfig
from .eye import STILL, Eye
from .instrument import render_tools
from .motion import Motion, ToolPose, build_motion
from .raster import FAR, rasterize, vertex_normals
from .sensor import develop, expose, exposure_gain, stereo_depth, vignette
from .shading import shade
from .side_views import side_eyes, side_picture
from .surface import MARGIN, Plane, build_anatomy, build_plane, organs_at, soften
from .texture import build_texture, smooth_patches
from .visibility import shown_elsewhere, visible_points

SUPERSAMPLE = 2
"""Image samples per pixel along each axis."""
_NOTE = "synthetic (endoprior phantom, seed {seed}); truth/tissue is free of tools and of sensor noise"
_TEXELS = 1.8
"""Texels per pixel of the first image."""
_FINER = 1.25
"""A grid that is uniform on the tissue is as fine everywhere as one that is uniform in the image is at its lower edge,
where the tissue is nearest."""
_LOOKS = 12
"""Views in each excursion in which tracked points are chosen."""


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
    path: CameraPath

    def vertices(self, phase: float) -> NDArray[np.float64]:
        """(MH, MW, 3) mesh in world axes, mm, at time `phase` in [0, 1]."""
        moved = self.motion.displacement(self.a, self.b, phase)
        return self.plane.lift(self.a + moved[..., 0], self.b + moved[..., 1], self.height + moved[..., 2])

    def endoscope(self, phase: float) -> Eye:
        """Its left camera in the world at time `phase`."""
        return Eye.posed(self.path.camera_to_world(phase))


@dataclass(frozen=True)
class Moment:
    """What moves, at one time, in the axes of the endoscope's left camera of that time."""

    endoscope: Eye
    """The left camera in the world."""
    vertices: NDArray[np.float64]
    """(MH, MW, 3) mesh, mm."""
    normals: NDArray[np.float32]
    """(MH, MW, 3) its unit normals."""
    tools: tuple[ToolPose, ToolPose]
    """In world axes."""

    @staticmethod
    def of(scene: Scene, phase: float) -> Moment:
        """The scene at time `phase` in [0, 1]."""
        endoscope = scene.endoscope(phase)
        vertices = endoscope.sees(scene.vertices(phase))
        return Moment(endoscope, vertices, vertex_normals(vertices), scene.motion.tools(phase))


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
    plane = build_plane(cfg)
    path = build_camera_path(cfg, plane)
    if path.excursions:
        plane = widened(plane, path, cfg)
    anatomy = build_anatomy(cfg.seed, plane.window if plane.metric else None)
    (across, down), texels = grid_sizes(cfg, plane)
    grid_v, grid_u = np.meshgrid(np.linspace(0, 1, down), np.linspace(0, 1, across), indexing="ij")
    a, b = plane.coordinates(grid_u, grid_v)
    spacing = float(np.diff(a[down // 2]).mean())
    height = soften(organs_at(anatomy, a, b).height, spacing, 0.7)
    texture = build_texture(plane, anatomy, *texels, cfg.smooth_share)
    return Scene(cfg, plane, build_motion(cfg, plane, anatomy), a, b, height, texture, path)


def grid_sizes(cfg: PhantomConfig, plane: Plane) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns and rows of the mesh, and of the texture."""
    # A vertex every two pixels, but enough for the shape of the loops.
    vertices = min(max(cfg.width / 2, 160), 480)
    if plane.metric:
        x0, x1, y0, y1 = plane.window
        wide = float(plane.origin[2]) * cfg.width / cfg.focal  # mm across the first image
        mesh, texture = vertices / wide, _FINER * _TEXELS * cfg.width / wide
        size = x1 - x0, y1 - y0
        vertices_across, vertices_down = (round(length * mesh) + 1 for length in size)
        return (vertices_across, vertices_down), (round(size[0] * texture), round(size[1] * texture))
    grown = 1 + 2 * MARGIN
    across = round(grown * vertices)
    texels = round(grown * _TEXELS * cfg.width), round(grown * _TEXELS * cfg.height)
    return (across, round(across * cfg.height / cfg.width)), texels


def render_view(scene: Scene, now: Moment, eye: Eye) -> RenderedView:
    """Render the tissue and the tools of one moment from one camera."""
    n = SUPERSAMPLE
    tissue, z = _tissue_samples(scene, now, eye, eye.center)
    assert z.max() < FAR, "the material ends inside the image"
    center = eye.center.astype(np.float32)
    color, depth = render_tools(now.tools, z, center, *_sample_grid(scene.cfg), now.endoscope)
    is_tool = depth < FAR
    image = np.where(is_tool[..., None], color, tissue)
    pooled = [_pooled(x, scene.cfg) for x in (tissue, image, is_tool.astype(np.float32))]
    nearest = np.minimum.reduce([depth[i::n, j::n] for i in range(n) for j in range(n)])
    return RenderedView(*pooled, nearest)


def render_tissue(scene: Scene, now: Moment, eye: Eye) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a side camera sees of the tissue: (H, W, 3) its radiance towards the endoscope, and (H, W) its z, mm.

    z is `FAR` where there is no tissue.
    """
    cfg = scene.cfg
    z = rasterize(eye.sees(now.vertices), cfg.focal, cfg.center, cfg.width, cfg.height)[..., 2]
    return _pooled(_tissue_samples(scene, now, eye, STILL.center)[0], cfg), z


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


def _sample_grid(cfg: PhantomConfig) -> tuple[float, tuple[float, float]]:
    """Focal length and principal point, px of the samples."""
    return SUPERSAMPLE * cfg.focal, (SUPERSAMPLE * cfg.center[0], SUPERSAMPLE * cfg.center[1])


def _pooled(samples: NDArray[np.float32], cfg: PhantomConfig) -> NDArray[np.float32]:
    return cv2.resize(samples, (cfg.width, cfg.height), interpolation=cv2.INTER_AREA)


def choose_tracks(scene: Scene) -> NDArray[np.int64]:
    """(P, 2) mesh rows and columns to track: two thirds spread over what is seen, the rest near the pulls.

    A camera that stands still has seen enough in the first image.
    """
    cfg = scene.cfg
    rng = np.random.default_rng([cfg.seed, 5])
    seen = np.zeros(scene.a.shape, bool)
    looks = _LOOKS * len(scene.path.excursions) + 1
    for phase in np.arange(looks) / max(looks - 1, 1):
        vertices = scene.endoscope(phase).sees(scene.vertices(phase))
        hits = rasterize(vertices, cfg.focal, cfg.center, cfg.width, cfg.height)
        seen |= visible_points(vertices, hits[..., 2], np.zeros(hits.shape[:2], bool), cfg)
    rows, columns = np.nonzero(seen)
    pull = sum(p.weight(scene.a, scene.b) for p in scene.motion.pulls)[rows, columns]
    spread = min(cfg.tracks * 2 // 3, len(rows))
    # np.nonzero lists vertices row by row: even steps through the list cover what is seen.
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


def write_phantom(out: Path, cfg: PhantomConfig, progress: Callable[[int, int], None] | None = None) -> None:
    """Write a synthetic sequence folder with ground truth to `out`.

    Beside the sequence (images, masks, depth, poses, `sequence.json`) it writes

    - `truth/tissue/*.png`, the image without tools and without sensor noise. Tools cast no shadow, so outside of them
      an image is the truth plus noise;
    - `truth/depth/*.npy`, (H, W) float32 z of the tool-free tissue, mm;
    - `truth/seen/*.npy`, (H, W) bool in test frames: behind a tool, and some training frame shows that tissue;
    - `truth/tracks.npz`: `points` (T, P, 3) float32 mm in the axes of the frame's camera, `visible` (T, P) bool; with
      `cfg.has_regions` also `region` (P,);
    - with `cfg.side_views` `truth/side/NAME/*.png` and `*.npy`: picture and depth of the side cameras in test frames,
      0 where the endoscope does not see the tissue; `truth/side/world_to_camera.json` has their poses (4, 4);
    - with `cfg.stereo` `right/*.png` and `calibration.json`;
    - with a moving `cfg.camera` `truth/camera_to_world.npy` (T, 4, 4), mm, as in `poses_bounds.npy`.

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
        # Masks cover the tool's blended rim and one pixel more, as annotators' outlines do.
        rim = np.ones((3, 3), np.uint8)
        points, visible, gain, sides = [], [], None, {}
        ever_seen, hidden = np.zeros(scene.a.shape, bool), {}
        for index in range(cfg.frames):
            phase = index / (cfg.frames - 1)
            now = Moment.of(scene, phase)
            view = render_view(scene, now, STILL)
            z = rasterize(now.vertices, focal, cfg.center, cfg.width, cfg.height)[..., 2]
            if gain is None:
                gain, sides = exposure_gain(view.tissue), side_eyes(float(np.median(z))) if cfg.side_views else {}
            truth = develop(view.tissue, gain, lens)
            rng = np.random.default_rng([cfg.seed, 6, index])
            image = expose(develop(view.image, gain, lens), cfg.noise, rng)
            mask = cv2.dilate((view.tool_share > 0).astype(np.uint8), rim) > 0
            measured = stereo_depth(np.minimum(z, view.tool_depth), image, cfg, rng)
            writer.write_image("truth/tissue", np.round(truth).astype(np.uint8))
            writer.write_array(f"truth/depth/{index:06d}.npy", z)
            for name, eye in sides.items() if is_test_frame(index) else ():
                seen = side_picture(*render_tissue(scene, now, eye), eye, z, mask, gain, cfg)
                writer.write_image(f"truth/side/{name}", seen[0])
                writer.write_array(f"truth/side/{name}/{index:06d}.npy", seen[1])
            right = None
            if cfg.stereo:
                other = render_view(scene, now, Eye.moved(cfg.baseline_mm))
                right = expose(develop(other.image, gain, lens), cfg.noise, np.random.default_rng([cfg.seed, 7, index]))
            writer.add(image, mask, measured, right)
            followed = now.vertices[tracked[:, 0], tracked[:, 1]]
            points.append(followed)
            visible.append(visible_points(followed, z, mask, cfg))
            if is_test_frame(index):
                hidden[index] = np.packbits(mask)
            else:
                ever_seen |= visible_points(now.vertices, z, mask, cfg)
            if progress is not None:
                progress(index + 1, cfg.frames)
        for index, packed in hidden.items():  # what is seen later is known only now
            phase = index / (cfg.frames - 1)
            vertices = scene.endoscope(phase).sees(scene.vertices(phase))
            hits = rasterize(vertices, focal, cfg.center, cfg.width, cfg.height)
            tool = np.unpackbits(packed, count=hits[..., 0].size).reshape(hits.shape[:2]) > 0
            writer.write_array(f"truth/seen/{index:06d}.npy", shown_elsewhere(hits, ever_seen, tool))
        tracks = {"points": np.stack(points).astype(np.float32), "visible": np.stack(visible)}
        if cfg.has_regions:
            tracks["region"] = regions(scene, tracked)
        writer.write_arrays("truth/tracks.npz", **tracks)
        if scene.path.excursions:
            writer.camera_to_world = scene.path.poses(cfg.frames)
            writer.write_array("truth/camera_to_world.npy", writer.camera_to_world)
        if sides:
            poses = {name: eye.world_to_camera.tolist() for name, eye in sides.items()}
            writer.write_json("truth/side/world_to_camera.json", poses)
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
