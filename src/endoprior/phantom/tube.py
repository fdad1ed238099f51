"""A bent tube with folds, as a colon or a bronchus, through which the camera drives forward with the lamp beside it.

It is rigid, without tools; `sinus` has another shape of the same. Letters: (MH, MW) mesh, rows along the tube and
columns around it; s is the arc length along its center line, a the one around its wall, mm. World axes are those of the
camera in frame 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..data.writer import FrameFiles
from .camera import AT_ORIGIN, CameraPose
from .config import PhantomConfig
from .noise import fractal
from .raster import FAR, vertex_normals
from .sensor import develop, expose, exposure_gain, stereo_depth, vignette
from .shading import shade
from .texture import CHANNELS
from .views import pixel_hits, pooled, sample_hits, visible_points

RADIUS_MM = 21.0
STEP_MM = 0.9  # the camera advances by this in each frame
BEHIND_MM, AHEAD_MM = 30.0, 190.0  # tube behind the camera in the first frame, and ahead of it in the last one
FOLD_MM, FOLD_WIDTH_MM, FOLD_DEPTH = 24.0, 3.5, 0.24  # distance between folds, their width, and depth as a share of R
MESH_MM, TEXELS_PER_MM = 0.9, 9.0
_COLORS = (0.78, 0.44, 0.36), (0.90, 0.64, 0.50), (0.55, 0.16, 0.14)  # display values: wall, pale wall, vessels


@dataclass(frozen=True)
class Tube:
    """What is static in one synthetic drive: of the scene `tube`, or of `sinus`."""

    vertices: NDArray[np.float64]  # (MH, MW, 3) mm, in world axes
    texture: NDArray[np.float32]  # (TH, TW, 7) material maps, as `texture.build_texture` has them
    poses: NDArray[np.float64]  # (T, 4, 4) camera-to-world, mm


def build_tube(cfg: PhantomConfig) -> Tube:
    """Tube, texture and drive of one seed."""
    rng = np.random.default_rng([cfg.seed, 11])
    length = BEHIND_MM + STEP_MM * (cfg.frames - 1) + AHEAD_MM
    s, around = np.arange(0, length, MESH_MM), 2 * np.pi * RADIUS_MM
    center, frames = _center_line(s, rng)
    angle = np.linspace(0, 2 * np.pi, round(around / MESH_MM) + 1)
    radius = _radius(s, angle, length, cfg.seed, rng)
    ring = np.cos(angle)[:, None] * frames[:, None, 0] + np.sin(angle)[:, None] * frames[:, None, 1]
    vertices = center[:, None] + radius[..., None] * ring
    return from_first_frame(vertices, wall_texture(length, around, cfg.seed), _drive(cfg, s, center, frames, rng))


def from_first_frame(vertices: NDArray, texture: NDArray, poses: NDArray) -> Tube:
    """A tube whose world becomes the axes of the camera in frame 0."""
    start = np.linalg.inv(poses[0])
    return Tube(vertices @ start[:3, :3].T + start[:3, 3], texture, start @ poses)


def _center_line(s: NDArray, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """(MH, 3) points and (MH, 3, 3) rows right, down, ahead of a line that bends slowly to all sides."""
    phases, periods = rng.uniform(0, 2 * np.pi, 2), rng.uniform(150, 210, 2)
    yaw, pitch = (0.42 * np.sin(2 * np.pi * s / period + phase) for period, phase in zip(periods, phases, strict=True))
    ahead = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], 1)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.cumsum(ahead, 0) * MESH_MM, np.stack([right, np.cross(ahead, right), ahead], 1)


def _radius(s: NDArray, angle: NDArray, length: float, seed: int, rng: np.random.Generator) -> NDArray:
    """(MH, MW) distance of the wall from the center line, mm; the tube is closed at its end."""
    folds = np.zeros((len(s), len(angle)))
    for at in np.arange(FOLD_MM / 2, length, FOLD_MM):
        at, lobe = at + rng.uniform(-5, 5), rng.uniform(0, 2 * np.pi)
        reach = 0.7 + 0.3 * np.cos(3 * angle + lobe)
        folds += np.exp(-(((s - at) / FOLD_WIDTH_MM) ** 2))[:, None] * reach
    swell = smooth_around(angle[None] * RADIUS_MM, s[:, None], 2 * np.pi * RADIUS_MM, 17.0, 2, seed + 200)
    radius = RADIUS_MM * (1 - FOLD_DEPTH * folds + 0.06 * swell)
    return radius * np.sqrt(np.clip((length - MESH_MM - s) / 12, 1e-8, 1))[:, None]


def smooth_around(a: NDArray, s: NDArray, around: float, scale: float, octaves: int, seed: int) -> NDArray[np.float32]:
    """Smooth noise at (a, s), mm, without a seam: two fields that fade into one another once around the tube."""
    a, s = np.broadcast_arrays(a, s)
    share = (a / around).astype(np.float32)
    first, second = (fractal((a - by) / scale, s / scale, octaves, seed) for by in (0, around))
    return np.asarray(((1 - share) * first + share * second) / np.hypot(1 - share, share), np.float32)


def wall_texture(
    length: float, around: float, seed: int, *, fine: float = 1.0, contrast: float = 1.0, gloss: float = 0.5
) -> NDArray[np.float32]:
    """(TH, TW, 7) color with vessels of a wall with these sides, mm, whose detail is so many times as `fine`; the mesh
    has all relief.
    """
    rows, columns = (round(side * fine * TEXELS_PER_MM) for side in (length, around))
    s, a = ((np.arange(n, dtype=np.float32) + 0.5) / TEXELS_PER_MM for n in (rows, columns))

    def noise(scale: float, octaves: int, more: int) -> NDArray[np.float32]:
        return smooth_around(a[None], s[:, None], around * fine, scale, octaves, seed + more)

    wall, pale, blood = (np.array(color, np.float32) ** np.float32(2.2) for color in _COLORS)
    mottle = np.clip(0.45 + 0.8 * noise(9.0, 3, 210) + 0.5 * noise(1.6, 3, 211), 0, 1)
    vessels = np.maximum(
        np.exp(-((noise(14.0, 3, 212) / 0.022) ** 2)), 0.7 * np.exp(-((noise(6.0, 3, 213) / 0.03) ** 2))
    )
    color = wall + mottle[..., None] * (pale - wall)
    color += (0.75 * vessels * np.clip(0.8 + 1.2 * noise(20.0, 1, 214), 0, 1))[..., None] * (blood - color)
    color = wall + contrast * (color - wall)
    out = np.zeros((rows, columns, CHANNELS), np.float32)
    out[..., :3], out[..., 5], out[..., 6] = color, gloss, 1.0
    return out


def _drive(
    cfg: PhantomConfig, s: NDArray, center: NDArray, frames: NDArray, rng: np.random.Generator
) -> NDArray[np.float64]:
    """(T, 4, 4) poses: forward near the center line, looking where it leads, swaying and rolling slowly."""
    at = BEHIND_MM + STEP_MM * np.arange(cfg.frames)
    phases = rng.uniform(0, 2 * np.pi, 5)
    sway = [np.sin(at / length + phase) for length, phase in zip((14, 17, 11, 13, 25), phases, strict=True)]
    poses = np.tile(np.eye(4), (cfg.frames, 1, 1))
    for k, place in enumerate(at):
        here, there = (np.array([np.interp(x, s, center[:, i]) for i in range(3)]) for x in (place, place + 28))
        right, down = frames[min(int(place / MESH_MM), len(s) - 1), :2]
        here = here + 3.5 * (sway[0][k] * right + sway[1][k] * down)
        ahead = there - here + 2.5 * (sway[2][k] * right + sway[3][k] * down)
        ahead /= np.linalg.norm(ahead)
        across = np.cross(down, ahead)
        across /= np.linalg.norm(across)
        turn, roll = np.stack([across, np.cross(ahead, across), ahead], 1), 0.12 * sway[4][k]
        poses[k, :3, :3] = turn @ np.array(
            [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
        )
        poses[k, :3, 3] = here
    return poses


def write_tube(
    writer: FrameFiles,
    tube: Tube,
    cfg: PhantomConfig,
    outside: NDArray[np.bool_],
    progress: Callable[[int, int], None],
) -> None:
    """Write frames, black and without depth `outside` (H, W), and truth of a tube: `truth/tissue`, `truth/depth`,
    `truth/camera_to_world.npy` and `truth/tracks.npz`, as `write_phantom` does.
    """
    lens, gain = vignette(cfg.width, cfg.height), 0.0
    points, visible, tracked = [], [], _tracks(tube, cfg)
    for index, pose in enumerate(tube.poses):
        seen = CameraPose.of(pose).to_camera(tube.vertices)
        radiance, z = _rendered(seen, tube.texture, cfg)
        gain = gain or exposure_gain(radiance)
        rng = np.random.default_rng([cfg.seed, 6, index])
        image = np.where(outside[..., None], np.uint8(0), expose(develop(radiance, gain, lens), cfg.noise, rng))
        writer.write_image("truth/tissue", np.round(develop(radiance, gain, lens)).astype(np.uint8))
        writer.write_array(f"truth/depth/{index:06d}.npy", z)
        at = seen[tracked[:, 0], tracked[:, 1]]
        points.append(at)
        visible.append(visible_points(at, z, outside, cfg))
        writer.add(image, outside, np.where(outside, np.float32(0), stereo_depth(z, image, cfg, rng)))
        progress(index + 1, cfg.frames)
    tracks = {"points": np.stack(points).astype(np.float32), "visible": np.stack(visible)}
    writer.write_arrays("truth/tracks.npz", **tracks)
    writer.camera_to_world = tube.poses
    writer.write_array("truth/camera_to_world.npy", tube.poses)


def _rendered(seen: NDArray, texture: NDArray, cfg: PhantomConfig) -> tuple[NDArray, NDArray[np.float32]]:
    """(H, W, 3) radiance and (H, W) z, mm, of the mesh (MH, MW, 3) in camera axes."""
    hits, focal, middle = sample_hits(seen, cfg)
    normals = vertex_normals(seen)
    assert hits[..., 2].max() < FAR, "the tube ends inside the image"
    radiance = shade(hits, normals, texture, np.eye(3)[:2], AT_ORIGIN, AT_ORIGIN.center, focal, middle)
    return pooled(radiance, cfg), pixel_hits(seen, cfg)[..., 2]


def _tracks(tube: Tube, cfg: PhantomConfig) -> NDArray[np.int64]:
    """(P, 2) mesh rows and columns of what the first, the middle or the last frame shows, evenly spread."""
    seen, no_tool = np.zeros(tube.vertices.shape[:2], bool), np.zeros((cfg.height, cfg.width), bool)
    for pose in tube.poses[[0, len(tube.poses) // 2, -1]]:
        vertices = CameraPose.of(pose).to_camera(tube.vertices)
        seen |= visible_points(vertices, pixel_hits(vertices, cfg)[..., 2], no_tool, cfg)
    places = np.argwhere(seen)
    return places[np.unique(np.linspace(0, len(places) - 1, cfg.tracks).astype(int))]
