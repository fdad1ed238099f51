"""Gaussians in few bytes: compressed PLY and SOG of PlayCanvas, SPZ of Niantic, .splat of antimatter15's viewer.

Sources: https://developer.playcanvas.com (compressed PLY; The SOG Format), https://github.com/nianticlabs/spz,
https://github.com/antimatter15/splat. SuperSplat and splat-transform read all. Equal Gaussians give equal bytes. `N`
Gaussians, `C` chunks. Encoders raise InputError for a position that is not finite;
decoders read what they write.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
from collections.abc import Callable
from typing import Any
from zipfile import ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray
from PIL.Image import fromarray
from PIL.Image import open as open_pixels

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.types import Splats
from ..model.gaussians import SH_C0
from ..model.scene import Scene
from ..render.sh import degree_of
from .formats import Axes, ExportFormat, ExportOptions
from .ply import GAUSSIAN_OPTIONS, ply_elements, splats_of, unit_quaternions, when
from .time_steps import TimeStep

# Compressed PLY: 16 bytes a Gaussian, and 18 floats for each chunk of 256 of them.

CHUNK = 256
LOG_SCALES = (-20.0, 20.0)
"""Readers take no log scale beyond."""
RANGES = [
    f"{end}_{name}"
    for names in ("x y z", "scale_x scale_y scale_z", "r g b")
    for end in ("min", "max")
    for name in names.split()
]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def compressed_ply(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The compressed PLY file of one time step."""
    unit, splats = length_unit(scene.lengths_are_relative), step.plain_splats(scene, options.axes)
    return {".ply": encode_compressed_ply(splats, options.axes, unit, when(scene, step))}


def encode_compressed_ply(splats: Splats, axes: Axes = "opencv", unit: str = "mm", comment: str = "") -> bytes:
    """All Gaussians along a curve that keeps neighbors together.

    Position and log scale: 11, 10 and 11 bits within the range of their chunk. Color 0.5 + C0 dc: 8 bits a channel
    within that of the chunk; opacity 8 bits. Rotation: the place of the largest of w, x, y, z in 2 bits, the three
    others in 10 bits each, times 1 / sqrt(2). Higher harmonics: 8 bits, steps of 8 / 255 from -4.
    """
    means, log_scales, quats, opacities, sh = _ordered(splats, "compressed_ply")
    (means, of_mean), (scales, of_scale), (colors, of_color) = map(
        _within_chunks, (means, log_scales, 0.5 + SH_C0 * sh[:, 0])
    )
    largest, others = _smallest_three(quats, 10)
    vertices = [
        _packed(_in_bits(means, (11, 10, 11)), (21, 11, 0)),
        largest << 30 | _packed(others, (20, 10, 0)),
        _packed(_in_bits(scales, (11, 10, 11)), (21, 11, 0)),
        _packed(np.column_stack([_in_bits(colors, 8), _in_bits(opacities, 8)]), (24, 16, 8, 0)),
    ]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * sh.shape[1] - 3)
    ranges = np.concatenate([of_mean, of_scale, of_color], 1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", f"comment axes {axes}, unit {unit}"]
    lines += [f"comment {comment}"] if comment else []
    lines += [f"element chunk {len(ranges)}", *(f"property float {name}" for name in RANGES)]
    lines += [f"element vertex {len(sh)}", *(f"property uint {name}" for name in PACKED)]
    if rest.shape[1]:
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    header = "\n".join([*lines, "end_header"]) + "\n"
    body = np.stack(vertices, 1).astype("<u4").tobytes() + _bytes((rest + 4) * (255 / 8)).tobytes()
    return header.encode() + ranges.tobytes() + body


def decode_compressed_ply(data: bytes) -> Splats:
    """The Gaussians of `encode_compressed_ply`, in the order of the file."""
    elements = ply_elements(data)
    words = np.stack([elements["vertex"][name] for name in PACKED], 1).astype(np.int64)
    ends = np.stack([elements["chunk"][name] for name in RANGES], 1).astype(np.float64)
    ends = np.repeat(ends, CHUNK, axis=0)[: len(words)].reshape(-1, 3, 2, 3)  # of position, log scale and color

    def within(shares: NDArray, which: int) -> NDArray[np.float64]:
        low, high = ends[:, which, 0], ends[:, which, 1]
        return low + shares * (high - low)

    means, log_scales = (_unpacked(words[:, k], (21, 11, 0), (11, 10, 11)) for k in (0, 2))
    others = _unpacked(words[:, 1], (20, 10, 0), (10, 10, 10))
    colors = _unpacked(words[:, 3], (24, 16, 8, 0), (8, 8, 8, 8))
    sh = [((within(colors[:, :3], 2) - 0.5) / SH_C0)[:, None]]
    if "sh" in elements:
        stored = elements["sh"]
        rest = np.stack([stored[name] for name in stored.dtype.names or ()], 1) * (8 / 255) - 4
        sh.append(rest.reshape(len(rest), 3, -1).transpose(0, 2, 1))
    return splats_of(
        means=within(means, 0),
        quats=_from_smallest_three(words[:, 1] >> 30, others),
        scales=np.exp(within(log_scales, 1)),
        opacities=colors[:, 3],
        sh=np.concatenate(sh, 1),
    )


def _within_chunks(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Where (N, 3) values lie between the ends of their chunk, 0..1, and (C, 6) these, rounded outward to float32."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return values, np.zeros((0, 6), np.float32)
    low = np.nextafter(np.minimum.reduceat(values, starts).astype(np.float32), np.float32(-np.inf))
    high = np.nextafter(np.maximum.reduceat(values, starts).astype(np.float32), np.float32(np.inf))
    ends = np.concatenate([low, high], 1)
    own = np.repeat(ends.astype(np.float64), CHUNK, axis=0)[: len(values)]
    return (values - own[:, :3]) / (own[:, 3:] - own[:, :3]), ends


def _packed(columns: NDArray[np.int64], shifts: tuple[int, ...]) -> NDArray[np.int64]:
    """(N,) columns of integers side by side in one, each shifted by so many bits."""
    return np.bitwise_or.reduce(columns << shifts, axis=1)


def _unpacked(words: NDArray[np.int64], shifts: tuple[int, ...], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """(N, C) shares, 0..1, of what `_packed` put side by side."""
    most = 2 ** np.array(bits) - 1
    return (words[:, None] >> np.array(shifts) & most) / most


# SOG version 2: a zip archive of images with one pixel per Gaussian, in the axes of a PLY file.

FIRST_ALPHA = 252
"""Alpha of a rotation whose largest part is w; one more for x, y, z."""


def encode_sog(splats: Splats) -> bytes:
    """All Gaussians along a curve that keeps neighbors together; no direction-dependent color.

    Position: 16 bits for sign(x) ln(|x| + 1) between the ends of each axis. Log scale and mean color: one of 256 equal
    steps. Opacity: 8 bits. Rotation: as in `_smallest_three`, 8 bits.
    """
    means, log_scales, quats, opacities, sh = _ordered(splats, "sog")
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    steps = _in_bits((logs - low) / np.maximum(high - low, 1e-9), 16)
    (scales, of_scale), (colors, of_color) = _by_codebook(log_scales), _by_codebook(sh[:, 0])
    largest, others = _smallest_three(quats, 8)
    images = {
        "means_l": steps & 255,
        "means_u": steps >> 8,
        "scales": scales,
        "quats": np.column_stack([others, FIRST_ALPHA + largest]),
        "sh0": np.column_stack([colors, _in_bits(opacities, 8)]),
    }
    about: dict[str, Any] = {"version": 2, "asset": {"generator": "endoprior"}, "count": len(means), "antialias": False}
    about["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    about["scales"] = {"codebook": of_scale, "files": ["scales.webp"]}
    about["quats"] = {"files": ["quats.webp"]}
    about["sh0"] = {"codebook": of_color, "files": ["sh0.webp"]}
    file = io.BytesIO()
    with ZipFile(file, "w") as archive:  # `ZipInfo` dates all files 1980; images are compressed as they are
        archive.writestr(ZipInfo("meta.json"), json.dumps(about, allow_nan=False))
        for name, values in images.items():
            archive.writestr(ZipInfo(f"{name}.webp"), _webp(values))
    return file.getvalue()


def decode_sog(data: bytes) -> Splats:
    """The Gaussians of `encode_sog`, in the order of the file."""
    with ZipFile(io.BytesIO(data)) as archive:
        about = json.loads(archive.read("meta.json"))

        def pixels(name: str) -> NDArray[np.int64]:
            with open_pixels(io.BytesIO(archive.read(f"{name}.webp"))) as image:
                values = np.array(image)
            return values.reshape(-1, values.shape[2])[: about["count"]].astype(np.int64)

        steps = pixels("means_l") | pixels("means_u") << 8
        scales, quats, colors = pixels("scales"), pixels("quats"), pixels("sh0")
    low, high = (np.array(about["means"][end]) for end in ("mins", "maxs"))
    logs = low + (high - low) * steps / 65535
    return splats_of(
        means=np.sign(logs) * np.expm1(np.abs(logs)),
        quats=_from_smallest_three(quats[:, 3] - FIRST_ALPHA, quats[:, :3] / 255),
        scales=np.exp(np.array(about["scales"]["codebook"])[scales]),
        opacities=colors[:, 3] / 255,
        sh=np.array(about["sh0"]["codebook"])[colors[:, None, :3]],
    )


def _by_codebook(values: NDArray[np.float64]) -> tuple[NDArray[np.int64], list[float]]:
    """The 8-bit place of each value in 256 equal steps, and these."""
    low, high = values.min(), values.max()
    return _in_bits((values - low) / max(high - low, 1e-9), 8), np.linspace(low, high, 256).round(6).tolist()


def _webp(values: NDArray[np.int64]) -> bytes:
    """(N, 3 or 4) bytes as the pixels of a lossless image about as high as wide, row by row."""
    width = 4 * math.ceil(math.sqrt(len(values)) / 4)
    pixels = np.zeros((math.ceil(len(values) / width), width, values.shape[1]), np.uint8)
    pixels.reshape(-1, values.shape[1])[: len(values)] = values
    file = io.BytesIO()
    fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


# SPZ version 2: a gzipped header and one block per attribute. Coordinates are right, up, back (OpenGL).

MAGIC, VERSION = 0x5053474E, 2
FRACTIONAL_BITS = 12
"""Of a coordinate, as in the format's own writer: steps of 1/4096 mm, range 2 m; fewer for a larger scene."""
COLOR_SCALE = 0.15
"""Stored color = 255 (0.15 dc + 0.5)."""


def encode_spz(splats: Splats) -> bytes:
    """Gaussians in their own order.

    Positions: 24-bit fixed point. Opacity, color, log scale (16 steps per unit from -10): 8 bits. Rotation: x, y, z of
    a unit quaternion with w >= 0, 8 bits each. Higher harmonics: 8 bits, 128 steps per unit, -1 to 1.
    """
    means, sh = _finite_means(splats, "spz"), splats.sh.numpy()
    largest = np.abs(means).max(initial=0.0)
    bits = next((n for n in range(FRACTIONAL_BITS, 0, -1) if largest * 2**n <= 2**23 - 1), 0)
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree_of(sh.shape[1]), bits, 0, 0)
    blocks = [
        np.rint(means * 2.0**bits).astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3],  # the low three bytes
        _bytes(splats.opacities.numpy() * 255),
        _bytes(sh[:, 0] * (COLOR_SCALE * 255) + 0.5 * 255),
        _bytes((np.log(splats.scales.numpy().clip(1e-30)) + 10) * 16),
        _bytes(_well_conditioned(splats.quats.numpy().astype(np.float64))[:, 1:] * 127.5 + 127.5),
        _bytes(sh[:, 1:] * 128 + 128),
    ]
    return gzip.compress(header + b"".join(block.tobytes() for block in blocks), mtime=0)


def decode_spz(data: bytes) -> Splats:
    """The Gaussians of `encode_spz`."""
    content = gzip.decompress(data)
    _, _, count, degree, bits, _, _ = struct.unpack_from("<IIIBBBB", content)
    widths = (9, 1, 3, 3, 3, 3 * ((degree + 1) ** 2 - 1))
    values = np.frombuffer(content, np.uint8, offset=16)
    blocks = np.split(values, np.cumsum([count * width for width in widths])[:-1])
    means, opacities, colors, log_scales, turns, rest = (
        block.reshape(count, width).astype(np.float64) for block, width in zip(blocks, widths, strict=True)
    )
    steps = means.reshape(count, 3, 3) @ [1, 2**8, 2**16]
    xyz = turns / 127.5 - 1
    w = np.sqrt((1 - (xyz**2).sum(1, keepdims=True)).clip(0))
    return splats_of(
        means=np.where(steps < 2**23, steps, steps - 2**24) / 2.0**bits,
        quats=np.concatenate([w, xyz], 1),
        scales=np.exp(log_scales / 16 - 10),
        opacities=opacities[:, 0] / 255,
        sh=np.concatenate([((colors / 255 - 0.5) / COLOR_SCALE)[:, None], rest.reshape(count, -1, 3) / 128 - 1], 1),
    )


def _well_conditioned(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (w, x, y, z) of the same ellipsoids with w at least 1/2.

    Readers compute w as sqrt(1 - x^2 - y^2 - z^2), which 8 bits cannot carry near w = 0. Half a turn about one of its
    own axes leaves an ellipsoid unchanged, and multiplies the quaternion by i, j or k: one of the four has a large w.
    """
    w, x, y, z = unit_quaternions(quats).T
    same = np.stack([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])  # q, q i, q j, q k
    best = np.abs(same[:, 0]).argmax(0)
    chosen = same[best, :, np.arange(len(quats))]
    return chosen * np.where(chosen[:, :1] < 0, -1, 1)


# .splat: 32 bytes per Gaussian, no header.

RECORD = np.dtype([("center", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""Center (mm), standard deviations (mm), color and opacity (0..255), quaternion w, x, y, z (128 + 128 q)."""


def encode_splat(splats: Splats) -> bytes:
    """Records sorted by opacity times volume, largest first, so that a viewer can show a file while it loads.

    No direction-dependent color.
    """
    scales, opacities = splats.scales.numpy(), splats.opacities.numpy()
    order = np.argsort(-scales.prod(1) * opacities, kind="stable")
    records = np.empty(len(scales), RECORD)
    records["center"], records["scale"] = splats.means.numpy(), scales
    records["rgba"] = _bytes(np.column_stack([splats.sh.numpy()[:, 0] * SH_C0 + 0.5, opacities]) * 255)
    records["rotation"] = _bytes(unit_quaternions(splats.quats.numpy()) * 128 + 128)
    return records[order].tobytes()


def decode_splat(data: bytes) -> Splats:
    """The Gaussians of `encode_splat`, in the order of the file."""
    records = np.frombuffer(data, RECORD)
    colors = records["rgba"] / 255
    return splats_of(
        means=records["center"],
        quats=records["rotation"] / 128 - 1,
        scales=records["scale"],
        opacities=colors[:, 3],
        sh=((colors[:, :3] - 0.5) / SH_C0)[:, None],
    )


# What they share.


def _finite_means(splats: Splats, name: str) -> NDArray[np.float64]:
    means = splats.means.numpy().astype(np.float64)
    if not np.isfinite(means).all():
        raise input_error(name, "finite positions", "NaN or infinity", "train the scene again.")
    return means


def _ordered(splats: Splats, name: str) -> list[NDArray[np.float64]]:
    """Positions, log scales, quaternions, opacities and coefficients along a Z-order curve of 2^10 cells an axis.

    `name` is the format's, for the error.
    """
    means = _finite_means(splats, name)
    low = means.min(0, initial=np.inf)
    size = max(float((means.max(0, initial=-np.inf) - low).max()), 1e-9)
    cells = np.floor((means - low) / size * 1023).astype(np.int64)
    bits = cells[:, None] >> np.arange(10)[:, None] & 1  # (N, 10, 3)
    places = (bits.reshape(len(means), 30) << np.arange(30)).sum(1)
    others = (splats.scales, splats.quats, splats.opacities, splats.sh)
    values = [means, *(tensor.numpy().astype(np.float64) for tensor in others)]
    values[1] = np.log(values[1].clip(1e-30)).clip(*LOG_SCALES)
    order = np.argsort(places, kind="stable")
    return [each[order] for each in values]


def _smallest_three(quats: NDArray[np.float64], bits: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(N,) the place of the largest of w, x, y, z, and (N, 3) the others, times 1 / sqrt(2), in so many bits."""
    unit = unit_quaternions(quats)
    largest = np.abs(unit).argmax(1)
    unit = unit * np.where(unit[np.arange(len(unit)), largest] < 0, -1, 1)[:, None]
    others = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, _in_bits(others / np.sqrt(2) + 0.5, bits)


def _from_smallest_three(largest: NDArray[np.int64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) unit quaternions of `_smallest_three`, whose integers are given as shares, 0..1."""
    quats = np.zeros((len(largest), 4))
    small = (others - 0.5) * np.sqrt(2)
    quats[np.arange(4) != largest[:, None]] = small.ravel()
    quats[np.arange(len(quats)), largest] = np.sqrt((1 - (small**2).sum(1)).clip(0))
    return quats


def _in_bits(shares: NDArray[np.float64], bits: int | tuple[int, ...]) -> NDArray[np.int64]:
    """The integers of so many bits for values in 0..1."""
    most = 2 ** np.array(bits) - 1
    return np.rint(shares * most).clip(0, most).astype(np.int64)


def _bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _format(
    suffix: str, encode: Callable[[Splats], bytes], decode: Callable[[bytes], Splats], axes: Axes = "opencv"
) -> ExportFormat:
    """A format of one file for each time step that says nothing of axes and time."""

    def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
        return {suffix: encode(step.plain_splats(scene, options.axes))}

    return ExportFormat((suffix,), GAUSSIAN_OPTIONS, files, default_axes=axes, holds="Gaussians", read=decode)


SOG, SPLAT = _format(".sog", encode_sog, decode_sog), _format(".splat", encode_splat, decode_splat)
SPZ = _format(".spz", encode_spz, decode_spz, "opengl")
COMPRESSED_PLY = ExportFormat(
    (".ply",),
    GAUSSIAN_OPTIONS,
    compressed_ply,
    holds="compressed Gaussians",
    read=decode_compressed_ply,
    has_index=False,
)
