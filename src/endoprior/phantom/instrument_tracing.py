# pyright: reportCallIssue=false
"""Sphere tracing of instruments: their pose, and the color and depth of each sample."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from .camera import AT_ORIGIN, CameraPose
from .graspers import draw_graspers
from .instrument_light import Material, paint_at, radiance_at
from .instrument_shapes import Part, distance
from .motion import ToolPose
from .raster import FAR
from .shading import LIGHTS_MM

_STEPS = 110
_TASKS = 64
_MIRRORED_PX = 16
"""Samples of the image per sample of its mirror image: instruments are not polished well enough for more."""


@dataclass(frozen=True)
class Instrument:
    """One instrument."""

    name: str
    """What a surgeon calls it."""
    parts: tuple[Part, ...]
    """Rows of `instrument_shapes`; the first `shaft_parts` are those that reach beyond `clear_mm`. None: `graspers`."""
    materials: tuple[Material, ...]
    length_mm: float
    """From the wrist to the tip."""
    clear_mm: float
    """Beyond this place on the shaft's x there is nothing but the shaft."""
    bound_mm: float
    """Radius of a cylinder around the shaft and all parts in its axes."""
    shaft_parts: int = 1
    wrist: tuple[float, float] = (1.0, 0.0)
    """Direction of the jaws: so much along the shaft, so much along the line of sight; the default is straight."""
    grip_mm: float = 2.0
    """Distance of the held tissue from the tip."""
    ball_mm: float = 0.0
    """Radius of a ball around the jaws, about the middle of their length; 0: half the length and 4 mm more."""
    opens: float = 1.0
    """Factor of the opening of the jaws."""
    roll: float = 0.0
    """Rotation of the jaws about their direction, rad, beside that of the pose."""


def pack(pose: ToolPose, tool: Instrument, first: int, seed: int) -> NDArray[np.float32]:
    """(31,) numbers of one instrument at one time.

    Wrist (3,), mm; axes x, y, z of the shaft and of the jaws, (3,) each; cosine and sine of half the opening; the rows
    of its first part and after its last one, the number of parts of the shaft; `clear_mm`, `bound_mm`, middle of the
    ball on the jaws' x and its radius, mm; a seed.

    Args:
        first: row of its first part in the table of all parts; of its first material if it has no parts.
    """
    view = _unit(pose.tip)
    jaw = _unit(tool.wrist[0] * _unit(pose.tip - pose.pivot) + tool.wrist[1] * view)
    wrist = pose.tip - (tool.length_mm - tool.grip_mm) * jaw
    back = _unit(pose.pivot - wrist)
    hinge = _unit(-view + (view @ jaw) * jaw)  # points roughly at the camera, so that the jaws are seen to open
    side = np.cross(hinge, jaw)
    c, s = np.cos(pose.roll + tool.roll), np.sin(pose.roll + tool.roll)
    hinge, side = c * hinge + s * side, c * side - s * hinge
    y = _unit(hinge - (hinge @ back) * back)
    half = tool.opens * pose.opening / 2
    ball = tool.ball_mm or tool.length_mm / 2 + 4
    counts = first, first + len(tool.parts), tool.shaft_parts
    bounds = tool.clear_mm, tool.bound_mm, tool.length_mm / 2, ball
    axes = back, y, np.cross(back, y), jaw, hinge, side
    return np.hstack((wrist, *axes, np.cos(half), np.sin(half), counts, bounds, seed % 4096)).astype(np.float32)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)


@njit(cache=True, fastmath=REORDERED)
def _span(g, camera, rx, ry, rz):
    # Where the ray (rx, ry, rz) from the camera enters and leaves the cylinder or the ball around tool g, mm.
    one, zero = np.float32(1), np.float32(0)
    mx, my, mz = camera[0] - g[0], camera[1] - g[1], camera[2] - g[2]
    ray_axis, camera_axis = rx * g[3] + ry * g[4] + rz * g[5], mx * g[3] + my * g[4] + mz * g[5]
    enter, leave = np.float32(1e9), np.float32(-1)
    a = max(one - ray_axis * ray_axis, np.float32(1e-6))
    b = mx * rx + my * ry + mz * rz - camera_axis * ray_axis
    root = b * b - a * (mx * mx + my * my + mz * mz - camera_axis * camera_axis - g[27] * g[27])
    if root > zero:
        root = np.sqrt(root)
        enter, leave = (-b - root) / a, (-b + root) / a
    mx, my, mz = mx - g[28] * g[12], my - g[28] * g[13], mz - g[28] * g[14]
    b = mx * rx + my * ry + mz * rz
    root = b * b - (mx * mx + my * my + mz * mz - g[29] * g[29])
    if root > zero:
        root = np.sqrt(root)
        enter, leave = min(enter, -b - root), max(leave, -b + root)
    return enter, leave


@njit(cache=True, fastmath=REORDERED)
def _mirrored(p, n, v, tissue_z, mirror, camera, focal, cx, cy, j, i, out):
    # What the surface at p with normal n mirrors towards v: writes out (3,) from `mirror` (MH, MW, 3), the tissue's
    # image. The mirrored ray meets the tissue about where it would if the tissue were flat.
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    facing = n[0] * v[0] + n[1] * v[1] + n[2] * v[2]
    rx, ry, rz = two * facing * n[0] - v[0], two * facing * n[1] - v[1], two * facing * n[2] - v[2]
    gap = max(tissue_z[i, j] + camera[2] - p[2], np.float32(3))
    far = min(gap / max(rz, np.float32(0.2)), np.float32(45))
    z = max(p[2] + far * rz - camera[2], np.float32(20))
    x = (focal * (p[0] + far * rx - camera[0]) / z + cx) / np.float32(tissue_z.shape[1]) * np.float32(mirror.shape[1])
    y = (focal * (p[1] + far * ry - camera[1]) / z + cy) / np.float32(tissue_z.shape[0]) * np.float32(mirror.shape[0])
    x = min(max(x - np.float32(0.5), zero), np.float32(mirror.shape[1]) - np.float32(1.001))
    y = min(max(y - np.float32(0.5), zero), np.float32(mirror.shape[0]) - np.float32(1.001))
    ix, iy = int(x), int(y)
    fx, fy = x - np.float32(ix), y - np.float32(iy)
    # Little light gets to what is behind the camera.
    lit = np.float32(0.38) + np.float32(0.62) * min(max(np.float32(0.45) + np.float32(1.3) * rz, zero), one)
    for c in range(3):
        top = mirror[iy, ix, c] * (one - fx) + mirror[iy, ix + 1, c] * fx
        low = mirror[iy + 1, ix, c] * (one - fx) + mirror[iy + 1, ix + 1, c] * fx
        out[c] = lit * (top * (one - fy) + low * fy)


@njit(inline="always")
def _gradient(p, g, parts, n):
    # Writes n (3,), along the gradient of the distance at p, from four corners of a small tetrahedron.
    e = np.float32(0.03)
    n[0] = n[1] = n[2] = np.float32(0)
    for corner in range(4):
        ex = e if corner == 0 or corner == 3 else -e
        ey = e if corner >= 2 else -e
        ez = e if corner == 1 or corner == 3 else -e
        d = distance(p[0] + ex, p[1] + ey, p[2] + ez, g, parts)[0]
        n[0], n[1], n[2] = n[0] + d * ex, n[1] + d * ey, n[2] + d * ez


@parallel_njit(fastmath=REORDERED)
def _draw(tools, parts, materials, tissue_z, mirror, camera, lights, focal, cx, cy, color, depth):
    # A task takes every 64th row. Sphere-traces each tool (T, 31) in front of the tissue tissue_z (SH, SW), mm; writes
    # color (SH, SW, 3) and depth (SH, SW), only where a tool is nearest.
    half, one = np.float32(0.5), np.float32(1)
    for task in prange(_TASKS):
        n, v, p = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
        seen, paint, radiance = np.zeros(3, np.float32), np.zeros(7, np.float32), np.zeros(3, np.float32)
        for s in range((depth.shape[0] - task + _TASKS - 1) // _TASKS * depth.shape[1]):
            i, j = task + s // depth.shape[1] * _TASKS, s % depth.shape[1]
            rx, ry = (np.float32(j) + half - cx) / focal, (np.float32(i) + half - cy) / focal
            rz = one / np.sqrt(rx * rx + ry * ry + one)
            rx, ry = rx * rz, ry * rz
            for k in range(tools.shape[0]):
                g = tools[k]
                enter, leave = _span(g, camera, rx, ry, rz)
                stop = min(min(tissue_z[i, j], depth[i, j]) / rz, leave)
                t, part, hit = max(enter, np.float32(8)), 0, False
                if t >= stop:
                    continue
                for _ in range(_STEPS):
                    d, part = distance(camera[0] + t * rx, camera[1] + t * ry, camera[2] + t * rz, g, parts)
                    if d < np.float32(0.012):
                        hit = True
                        break
                    t += np.float32(0.92) * d
                    if t > stop:
                        break
                if not hit or t >= stop:
                    continue
                p[0], p[1], p[2] = camera[0] + t * rx, camera[1] + t * ry, camera[2] + t * rz
                _gradient(p, g, parts, n)
                norm = one / max(np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), np.float32(1e-9))
                n[0], n[1], n[2] = n[0] * norm, n[1] * norm, n[2] * norm
                v[0], v[1], v[2] = -rx, -ry, -rz
                dx, dy, dz = p[0] - g[0], p[1] - g[1], p[2] - g[2]
                m = materials[int(parts[part, 2])]
                paint_at(
                    m,
                    dx * g[3] + dy * g[4] + dz * g[5],
                    dx * g[6] + dy * g[7] + dz * g[8],
                    dx * g[9] + dy * g[10] + dz * g[11],
                    int(g[30]),
                    n,
                    paint,
                )
                _mirrored(p, n, v, tissue_z, mirror, camera, focal, cx, cy, j, i, seen)
                radiance_at(n, v, p, paint, m[7], seen, lights, radiance)
                depth[i, j] = t * rz
                for c in range(3):
                    color[i, j, c] = radiance[c]


def render_instruments(
    poses: tuple[ToolPose, ...],
    instruments: tuple[Instrument, ...],
    seed: int,
    tissue: NDArray[np.float32],
    tissue_z: NDArray[np.float32],
    camera: NDArray[np.floating],
    focal: float,
    center: tuple[float, float],
    endoscope: CameraPose = AT_ORIGIN,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Render instruments in front of the tissue.

    Args:
        poses: in world axes. instruments: as many, all with parts or all without. seed: of print, stains and wear.
        tissue: (SH, SW, 3) linear radiance of the tissue, which metals mirror. tissue_z: (SH, SW) its depth, mm.
        camera: (3,) camera center in the left camera's axes, mm.
        focal, center: of the sample grid, px.
        endoscope: the left camera in the world.
    Returns:
        (SH, SW, 3) linear radiance and (SH, SW) z in mm; z = raster.FAR where no tool is visible.
    """
    parts, materials, tools = [], [], []
    for k, (pose, tool) in enumerate(zip(poses, instruments, strict=True)):
        tools.append(pack(pose, tool, len(parts) if tool.parts else len(materials), seed + k))
        parts += [(*part[:2], part[2] + len(materials), *part[3:]) for part in tool.parts]
        materials += [material.row() for material in tool.materials]
    packed = np.stack(tools)
    # A point and six directions, chosen in the world: a tool that is static stays so when the camera moves.
    packed[:, :3] = endoscope.to_camera(packed[:, :3])
    packed[:, 3:21] = (packed[:, 3:21].reshape(-1, 6, 3) @ endoscope.rotation).reshape(-1, 18)
    color = np.zeros((*tissue_z.shape, 3), np.float32)
    depth = np.full(tissue_z.shape, FAR, np.float32)
    f, cx, cy = (np.float32(value) for value in (focal, *center))
    view = camera.astype(np.float32), LIGHTS_MM, f, cx, cy
    if not parts:
        draw_graspers(packed, np.stack(materials), tissue_z, *view, color, depth)
        return color, depth
    small = [max(2, round(size / _MIRRORED_PX)) for size in tissue_z.shape]
    mirror = cv2.GaussianBlur(cv2.resize(tissue, small[::-1], interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    _draw(packed, np.array(parts, np.float32), np.stack(materials), tissue_z, mirror, *view, color, depth)
    return color, depth
