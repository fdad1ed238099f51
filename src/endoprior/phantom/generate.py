"""Write a synthetic sequence with ground truth: build the anatomy once, then deform, render and expose each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.sequence import is_test_frame
from ..data.writer import SequenceMeta, new_sequence
from .camera_path import build_camera_path, widened
from .config import PhantomConfig
from .eye import STILL, Eye
from .instrument_families import instruments_of
from .motion import Motion, build_motion
from .raster import rasterize
from .scene import Moment, Scene
from .sensor import develop, expose, exposure_gain, stereo_depth, vignette
from .side_views import side_eyes, side_picture
from .smoke import Smoke
from .surface import MARGIN, Plane, build_anatomy, build_plane, organs_at, soften
from .texture import build_texture, smooth_patches
from .tissue_looks import LOOKS
from .views import render_tissue, render_view
from .visibility import shown_elsewhere, visible_points

_NOTE = "synthetic (endoprior phantom, seed {seed}{kinds}); truth/tissue is free of tools and of sensor noise"
_TEXELS = 1.8
"""Texels per pixel of the first image."""
_FINER = 1.25
"""A grid that is uniform on the tissue is as fine everywhere as one that is uniform in the image is at its lower edge,
where the tissue is nearest."""
_LOOKS = 12
"""Views in each excursion in which tracked points are chosen."""


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
    look = LOOKS[cfg.tissue]
    height = soften(organs_at(anatomy, a, b).height, spacing, look.blurred_mm)
    texture = build_texture(plane, anatomy, *texels, cfg.smooth_share, look)
    motion = build_motion(cfg, plane, anatomy)
    if look.blurred_mm > LOOKS["bowel"].blurred_mm:
        motion = _on_surface(motion, a, b, height)
    tools = None if cfg.instruments == "graspers" else instruments_of(cfg.instruments, cfg.seed)
    smoke = Smoke.of(cfg, look.smoke) if look.smoke > 0 else None
    return Scene(cfg, plane, motion, a, b, height, texture, path, look, tools, smoke)


def _on_surface(motion: Motion, a: NDArray, b: NDArray, height: NDArray) -> Motion:
    """The motion with pulls that hold the mesh `a`, `b`, `height` (MH, MW), mm, where smoothing has lowered it."""
    nearest = [np.argmin((a - pull.center[0]) ** 2 + (b - pull.center[1]) ** 2) for pull in motion.pulls]
    pulls = [replace(pull, height=float(height.flat[k])) for pull, k in zip(motion.pulls, nearest, strict=True)]
    return replace(motion, pulls=tuple(pulls))


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
    - with `cfg.has_kinds` `truth/scene.json`: kinds of tools and tissue, names of the tools, and the density of smoke
      in each frame, 0..1; `truth/tissue` shows the smoke too, the side cameras do not;
    - with a moving `cfg.camera` `truth/camera_to_world.npy` (T, 4, 4), mm, as in `poses_bounds.npy`.

    Args:
        out: a new or empty folder; it appears when complete.
        cfg: size, seed, motion, noise.
        progress: called with (frames done, frames) after each frame.
    Raises:
        InputError: `out` is in use.
    """
    (cx, cy), focal = cfg.center, cfg.focal
    kinds = f", instruments {cfg.instruments}, tissue {cfg.tissue}" if cfg.has_kinds else ""
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
        note=_NOTE.format(seed=cfg.seed, kinds=kinds),
    )
    with new_sequence(out, meta) as writer:
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
                gain, sides = _gain(view.tissue, scene), side_eyes(float(np.median(z))) if cfg.side_views else {}
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
        if cfg.has_kinds:
            writer.write_json("truth/scene.json", _description(scene))


def _gain(tissue: NDArray[np.float32], scene: Scene) -> float:
    """The exposure of the whole sequence, chosen from the tool-free radiance (H, W, 3) of its first frame."""
    return exposure_gain(tissue) * scene.look.exposure


def _description(scene: Scene) -> dict[str, object]:
    """What is in the scene: kinds of tools and tissue, names of the tools, density of the smoke in each frame."""
    cfg = scene.cfg
    names = [tool.name for tool in scene.instruments] if scene.instruments else ["grasper", "grasper"]
    described = {"instruments": cfg.instruments, "tools": names, "tissue": cfg.tissue}
    if scene.smoke is not None:
        described["smoke"] = [round(scene.smoke.density(k / (cfg.frames - 1)), 4) for k in range(cfg.frames)]
    return described


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
