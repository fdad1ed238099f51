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
from .ply import when
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
    unit, splats = length_unit(scene.lengths_are_relative), step.plain_splats(scene, options.frame)
    return {".ply": encode_compressed_ply(splats, options.frame, unit, when(scene, step))}


def encode_compressed_ply(splats: Splats, axes: Axes = "opencv", unit: str = "mm", comment: str = "") -> bytes:
    """All Gaussians along a curve that keeps neighbors together, equal bytes for equal input.

    Position and log scale: 11, 10 and 11 bits within the range of their chunk. Color 0.5 + C0 dc: 8 bits a channel
    within that of the chunk; opacity 8 bits. Rotation: the place of the largest of w, x, y, z in 2 bits, the three
    others in 10 bits each, times 1 / sqrt(2). Higher harmonics: 8 bits, steps of 8 / 255 from -4.

    Raises:
        InputError: a position is not finite.
    """
    means, log_scales, quats, opacities, sh = ordered(splats, "compressed_ply")
    colors = 0.5 + SH_C0 * sh[:, 0]
    of_mean, of_scale, of_color = (_ranges(values) for values in (means, log_scales, colors))
    red, green, blue = in_bits(_within(colors, of_color), 8).T
    vertices = np.stack(
        [
            _packed(_within(means, of_mean)),
            _packed_rotations(quats),
            _packed(_within(log_scales, of_scale)),
            red << 24 | green << 16 | blue << 8 | in_bits(opacities, 8),
        ],
        1,
    )
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * sh.shape[1] - 3)
    harmonics = np.rint((rest + 4) * (255 / 8)).clip(0, 255).astype(np.uint8)
    ranges = np.concatenate([of_mean, of_scale, of_color], 1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", f"comment axes {axes}, unit {unit}"]
    lines += [f"comment {comment}"] if comment else []
    lines += [f"element chunk {len(ranges)}", *(f"property float {name}" for name in RANGES)]
    lines += [f"element vertex {len(vertices)}", *(f"property uint {name}" for name in PACKED)]
    if rest.shape[1]:
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    header = "\n".join([*lines, "end_header"]) + "\n"
    return header.encode() + ranges.tobytes() + vertices.astype("<u4").tobytes() + harmonics.tobytes()


def ordered(splats: Splats, name: str) -> tuple[NDArray[np.float64], ...]:
    """Positions, log scales, quaternions, opacities and coefficients along a curve that keeps neighbors together.

    Raises:
        InputError: names the format `name`: a position is not finite.
    """
    means = splats.means.numpy().astype(np.float64)
    if not np.isfinite(means).all():
        raise input_error(name, "finite positions", "NaN or infinity", "train the scene again.")
    order = np.argsort(_morton(means), kind="stable")
    scales, *others = (
        tensor.numpy().astype(np.float64)[order]
        for tensor in (splats.scales, splats.quats, splats.opacities, splats.sh)
    )
    return means[order], np.log(scales.clip(1e-30)).clip(*LOG_SCALES), *others


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


def in_bits(shares: NDArray[np.float64], bits: int) -> NDArray[np.int64]:
    """The integers of so many bits for values in 0..1."""
    return np.rint(shares * (2**bits - 1)).clip(0, 2**bits - 1).astype(np.int64)


def smallest_three(quats: NDArray[np.float64], bits: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(N,) the place of the largest of w, x, y, z, and (N, 3) the others, times 1 / sqrt(2), in so many bits."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(1)
    rows = np.arange(len(unit))
    unit = unit * np.where(unit[rows, largest] < 0, -1, 1)[:, None]
    others = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, in_bits(others / np.sqrt(2) + 0.5, bits)


def _packed(shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) three shares in 11, 10 and 11 bits."""
    x, y, z = (in_bits(shares[:, i], bits) for i, bits in enumerate((11, 10, 11)))
    return x << 21 | y << 11 | z


def _packed_rotations(quats: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) of quaternions (w, x, y, z) of any length."""
    largest, others = smallest_three(quats, 10)
    a, b, c = others.T
    return largest << 30 | a << 20 | b << 10 | c


FORMAT = Format(
    suffixes=(".ply",),
    options=(*TIME_STEP_OPTIONS, "canonical"),
    files=files,
    holds="compressed Gaussians",
    has_index=False,  # as in a folder of `ply`
)
