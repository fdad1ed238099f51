"""The scene: what is static in one synthetic sequence, and what moves, at one time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import CameraPath, CameraPose, build_camera_path, widened
from .config import PhantomConfig
from .instrument_families import instruments_of
from .instrument_tracing import Instrument
from .motion import PhantomMotion, ToolPose, build_motion, smooth_step
from .noise import fractal
from .raster import vertex_normals
from .surface import MARGIN, Plane, build_anatomy, build_plane, organs_at, soften
from .texture import LOOKS, TissueLook, build_texture

_PUFF_FRAMES = 40
"""A puff of smoke comes about once in so many frames."""
_DEPTH_MM = 80.0
"""Depth for which the densest smoke is given."""
_VEIL_MM = 50.0
"""Distance at which the clouds are as large as they look."""
_COLOR = np.array([0.32, 0.335, 0.35], np.float32)
"""Linear radiance of dense smoke on the optical axis, where tissue of medium color has about 0.3."""
_COARSE = 8
"""Samples of the image per sample of the clouds."""


@dataclass(frozen=True)
class Smoke:
    """The smoke of one seed."""

    seed: int
    frames: int
    peaks: NDArray[np.float64]
    """(P,) density of each puff at its height, 0..1."""
    strongest: float
    """Share of the light that smoke of density 1 takes away within 80 mm, 0..1."""

    @staticmethod
    def of(cfg: PhantomConfig, strongest: float) -> Smoke:
        """Choose the puffs."""
        rng = np.random.default_rng([cfg.seed, 10])
        peaks = rng.uniform(0.6, 1.0, max(1, round(cfg.frames / _PUFF_FRAMES)))
        return Smoke(cfg.seed, cfg.frames, peaks, strongest)

    def density(self, phase: float) -> float:
        """0..1 at time `phase` in [0, 1]; 0 at both ends, so that the first frame sets the exposure without smoke."""
        count = len(self.peaks)
        k = min(int(phase * count), count - 1)
        local = phase * count - k
        return float(self.peaks[k] * smooth_step(0.06, 0.35, local) * (1 - smooth_step(0.55, 0.97, local)))

    def veiled(
        self, radiance: NDArray, z: NDArray, phase: float, pose: CameraPose, focal: float, center: tuple[float, float]
    ) -> NDArray:
        """(SH, SW, 3) float32 linear radiance behind smoke, mixed with the light that the smoke scatters back.

        Args:
            radiance: (SH, SW, 3) without smoke. z: (SH, SW) depth of what is seen, mm.
            pose: the camera, in the axes of the endoscope's left one, with which the smoke moves.
            focal, center: of the sample grid, px.
        """
        density = self.density(phase)
        if density == 0:
            return radiance
        height, width = z.shape
        y, x = np.mgrid[:height:_COARSE, :width:_COARSE].astype(np.float32)
        x, y = (x - center[0]) / focal, (y - center[1]) / focal
        clouds = self._clouds(x * _VEIL_MM + pose.center[0], y * _VEIL_MM + pose.center[1], phase) * density
        # The light guides shine less away from the optical axis.
        axis = (1 / (1 + np.hypot(x, y) ** 2) ** 2).astype(np.float32)
        columns, rows = np.meshgrid(*(np.arange(size, dtype=np.float32) / _COARSE for size in (width, height)))
        dense, lit = (
            cv2.remap(coarse, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for coarse in (clouds, axis)
        )
        lost = 1 - np.exp(np.float32(np.log(1 - self.strongest) / _DEPTH_MM) * dense * z)
        return radiance + lost[..., None] * (_COLOR * lit[..., None] - radiance)

    def _clouds(self, x: NDArray, y: NDArray, phase: float) -> NDArray:
        """In [0.12, 1.8]: relative density of the smoke at x, y, mm to the right and down."""
        time = phase * (self.frames - 1)
        # It rises and swirls; the slow field carries the fine one along.
        slow = fractal(x / 30 + 0.02 * time, y / 30 + 0.035 * time, 2, self.seed + 60)
        fine = fractal(x / 11 + 1.2 * slow - 0.03 * time, y / 11 + 0.08 * time, 3, self.seed + 61)
        return np.clip(0.8 + 1.5 * slow + 0.6 * fine, 0.12, 1.8).astype(np.float32)


_TEXELS = 1.8
"""Texels per pixel of the first image."""
_FINER = 1.25
"""A grid that is uniform on the tissue is as fine everywhere as one that is uniform in the image is at its lower edge,
where the tissue is nearest."""


@dataclass(frozen=True)
class PhantomScene:
    """The static parts of one synthetic sequence."""

    cfg: PhantomConfig
    plane: Plane
    motion: PhantomMotion
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    height: NDArray[np.float32]
    """(MH, MW) each: plane coordinates and rest height of the mesh vertices, mm."""
    texture: NDArray[np.float32]
    """(TH, TW, 7) material maps."""
    path: CameraPath
    look: TissueLook
    instruments: tuple[Instrument, Instrument]
    smoke: Smoke | None

    def vertices(self, phase: float) -> NDArray[np.float64]:
        """(MH, MW, 3) mesh in world axes, mm, at time `phase` in [0, 1]."""
        moved = self.motion.displacement(self.a, self.b, phase)
        return self.plane.lift(self.a + moved[..., 0], self.b + moved[..., 1], self.height + moved[..., 2])

    def endoscope(self, phase: float) -> CameraPose:
        """Its left camera in the world at time `phase`."""
        return CameraPose.of(self.path.camera_to_world(phase))

    def seen_vertices(self, phase: float) -> NDArray[np.float64]:
        """(MH, MW, 3) mesh in the axes of the endoscope's left camera at time `phase`, mm."""
        return self.endoscope(phase).to_camera(self.vertices(phase))


@dataclass(frozen=True)
class SceneState:
    """The scene at one time: what moves, in the axes of the endoscope's left camera of that time."""

    endoscope: CameraPose
    vertices: NDArray[np.float64]
    normals: NDArray[np.float32]
    """(MH, MW, 3) mesh, mm, and its unit normals."""
    tools: tuple[ToolPose, ToolPose]
    """In world axes."""
    phase: float = 0.0

    @staticmethod
    def of(scene: PhantomScene, phase: float) -> SceneState:
        """The scene at time `phase` in [0, 1]."""
        vertices = scene.seen_vertices(phase)
        return SceneState(scene.endoscope(phase), vertices, vertex_normals(vertices), scene.motion.tools(phase), phase)


def build_scene(cfg: PhantomConfig) -> PhantomScene:
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
        # Pulls hold the mesh where smoothing has lowered it.
        nearest = [np.argmin((a - pull.center[0]) ** 2 + (b - pull.center[1]) ** 2) for pull in motion.pulls]
        lowered = [replace(p, height=float(height.flat[k])) for p, k in zip(motion.pulls, nearest, strict=True)]
        motion = replace(motion, pulls=tuple(lowered))
    tools = instruments_of(cfg.instruments, cfg.seed)
    strongest = cfg.smoke or look.smoke
    smoke = Smoke.of(cfg, strongest) if strongest > 0 else None
    return PhantomScene(cfg, plane, motion, a, b, height, texture, path, look, tools, smoke)


def grid_sizes(cfg: PhantomConfig, plane: Plane) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns and rows of the mesh, and of the texture."""
    # A vertex every two pixels, but enough for the shape of the loops.
    vertices = min(max(cfg.width / 2, 160), 480)
    if plane.metric:
        x0, x1, y0, y1 = plane.window
        wide = float(plane.origin[2]) * cfg.width / cfg.focal  # mm across the first image
        mesh, texture = vertices / wide, _FINER * _TEXELS * cfg.width / wide
        across, down = x1 - x0, y1 - y0
        return (round(across * mesh) + 1, round(down * mesh) + 1), (round(across * texture), round(down * texture))
    grown = 1 + 2 * MARGIN
    columns = round(grown * vertices)
    texels = round(grown * _TEXELS * cfg.width), round(grown * _TEXELS * cfg.height)
    return (columns, round(columns * cfg.height / cfg.width)), texels
