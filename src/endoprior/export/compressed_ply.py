"""Compressed PLY of PlayCanvas: 16 bytes a Gaussian, and 18 floats for each chunk of 256 of them.

Read by SuperSplat, PlayCanvas and splat-transform. Source: https://developer.playcanvas.com (compressed PLY). `N`
Gaussians, `C` chunks, `K` spherical-harmonic coefficients per channel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.types import Splats
from ..model.gaussians import SH_C0
from ..model.scene import Scene
from .formats import TIME_STEP_OPTIONS, Axes, Format
from .options import ExportOptions
from .time_steps import TimeStep

CHUNK = 256
LOG_SCALES = (-20.0, 20.0)
"""Readers take no log scale beyond."""
RANGES = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
RANGES += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
RANGES += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The compressed PLY file of one time step."""
    unit = length_unit(scene.lengths_are_relative)
    return {".ply": encode_compressed_ply(step.plain_splats(scene, options.frame), options.frame, unit)}


def encode_compressed_ply(splats: Splats, axes: Axes = "opencv", unit: str = "mm") -> bytes:
    """All Gaussians along a curve that keeps neighbors together, equal bytes for equal input.

    Position and log scale: 11, 10 and 11 bits within the range of their chunk. Color 0.5 + C0 dc: 8 bits a channel
    within that of the chunk; opacity 8 bits. Rotation: the place of the largest of w, x, y, z in 2 bits, the three
    others in 10 bits each, times 1 / sqrt(2). Higher harmonics: 8 bits, steps of 8 / 255 from -4.

    Raises:
        InputError: a position is not finite.
    """
    means = splats.means.numpy().astype(np.float64)
    if not np.isfinite(means).all():
        raise input_error("compressed_ply", "finite positions", "NaN or infinity", "train the scene again.")
    order = np.argsort(_morton(means), kind="stable")
    means, sh = means[order], splats.sh.numpy().astype(np.float64)[order]
    log_scales = np.log(splats.scales.numpy().astype(np.float64)[order].clip(1e-30)).clip(*LOG_SCALES)
    colors = 0.5 + SH_C0 * sh[:, 0]
    opacities = splats.opacities.numpy().astype(np.float64)[order]
    of_mean, of_scale, of_color = (_ranges(values) for values in (means, log_scales, colors))
    red, green, blue = _bits(_within(colors, of_color), 8).T
    vertices = np.stack(
        [
            _packed(_within(means, of_mean)),
            _packed_rotations(splats.quats.numpy().astype(np.float64)[order]),
            _packed(_within(log_scales, of_scale)),
            red << 24 | green << 16 | blue << 8 | _bits(opacities, 8),
        ],
        1,
    )
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * sh.shape[1] - 3)
    harmonics = np.rint((rest + 4) * (255 / 8)).clip(0, 255).astype(np.uint8)
    ranges = np.concatenate([of_mean, of_scale, of_color], 1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", f"comment axes {axes}, unit {unit}"]
    lines += [f"element chunk {len(ranges)}", *(f"property float {name}" for name in RANGES)]
    lines += [f"element vertex {len(vertices)}", *(f"property uint {name}" for name in PACKED)]
    if rest.shape[1]:
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    header = "\n".join([*lines, "end_header"]) + "\n"
    return header.encode() + ranges.tobytes() + vertices.astype("<u4").tobytes() + harmonics.tobytes()


def _morton(means: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) place of each position (N, 3) on a Z-order curve of 2^10 cells along each axis."""
    if not len(means):
        return np.zeros(0, np.int64)
    size = max(float(np.ptp(means, axis=0).max()), 1e-9)
    cells = np.floor((means - means.min(0)) / size * 1023).astype(np.int64)
    places = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            places |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return places


def _ranges(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """(C, 6) the least and the largest of (N, 3) values in each chunk, rounded outward to float32."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return np.zeros((0, 6), np.float32)
    low = np.minimum.reduceat(values, starts).astype(np.float32)
    high = np.maximum.reduceat(values, starts).astype(np.float32)
    return np.concatenate([np.nextafter(low, -np.inf), np.nextafter(high, np.inf)], 1, dtype=np.float32)


def _within(values: NDArray[np.float64], ranges: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N, 3) where each value lies between the ends of its chunk, 0..1."""
    own = np.repeat(ranges.astype(np.float64), CHUNK, axis=0)[: len(values)]
    return (values - own[:, :3]) / (own[:, 3:] - own[:, :3])


def _bits(shares: NDArray[np.float64], bits: int) -> NDArray[np.int64]:
    return np.rint(shares * (2**bits - 1)).clip(0, 2**bits - 1).astype(np.int64)


def _packed(shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) three shares in 11, 10 and 11 bits."""
    x, y, z = (_bits(shares[:, i], bits) for i, bits in enumerate((11, 10, 11)))
    return x << 21 | y << 11 | z


def _packed_rotations(quats: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) of quaternions (w, x, y, z) of any length."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(1)
    rows = np.arange(len(unit))
    unit = unit * np.where(unit[rows, largest] < 0, -1, 1)[:, None]
    others = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    a, b, c = _bits(others / np.sqrt(2) + 0.5, 10).T
    return largest << 30 | a << 20 | b << 10 | c


FORMAT = Format(
    suffixes=(".ply",), options=(*TIME_STEP_OPTIONS, "canonical"), files=files, holds="compressed Gaussians"
)
