"""SPZ version 2: a gzipped header and one block per attribute, several times smaller than the PLY.

Source: https://github.com/nianticlabs/spz. Coordinates are right, up, back (OpenGL).
"""

from __future__ import annotations

import gzip
import struct

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.types import Splats
from ..model.scene import Scene
from ..render.sh import degree_of
from .formats import TIME_STEP_OPTIONS, Format
from .options import ExportOptions
from .time_steps import TimeStep

MAGIC, VERSION = 0x5053474E, 2
FRACTIONAL_BITS = 12
"""Of a coordinate, as in the format's own writer: steps of 1/4096 mm, range 2 m; fewer for a larger scene."""
COLOR_SCALE = 0.15
"""Stored color = 255 (0.15 dc + 0.5)."""
_LARGEST = 2**23 - 1


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The SPZ file of one time step."""
    return {".spz": encode_spz(step.plain_splats(scene, options.frame))}


def encode_spz(splats: Splats) -> bytes:
    """All Gaussians, equal bytes for equal input.

    Positions: 24-bit fixed point. Opacity, color, log scale (16 steps per unit from -10): 8 bits. Rotation: x, y, z of
    a unit quaternion with w >= 0, 8 bits each. Higher harmonics: 8 bits, 128 steps per unit, -1 to 1.

    Raises:
        InputError: a position is not finite.
    """
    means, sh = splats.means.numpy().astype(np.float64), splats.sh.numpy()
    if not np.isfinite(means).all():
        raise input_error("spz", "finite positions", "NaN or infinity", "train the scene again.")
    fractional_bits = _fractional_bits(np.abs(means).max(initial=0.0))
    fixed = np.rint(means * 2.0**fractional_bits).astype("<i4")
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree_of(sh.shape[1]), fractional_bits, 0, 0)
    blocks = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],  # the low three bytes, little-endian
        _bytes(splats.opacities.numpy() * 255),
        _bytes(sh[:, 0] * (COLOR_SCALE * 255) + 0.5 * 255),
        _bytes((np.log(splats.scales.numpy().clip(1e-30)) + 10) * 16),
        _bytes(_well_conditioned(splats.quats.numpy().astype(np.float64))[:, 1:] * 127.5 + 127.5),
        _bytes(sh[:, 1:] * 128 + 128),
    ]
    return gzip.compress(header + b"".join(block.tobytes() for block in blocks), mtime=0)


def _fractional_bits(largest: float) -> int:
    bits = FRACTIONAL_BITS
    while bits > 0 and largest * 2**bits > _LARGEST:
        bits -= 1
    return bits


def _bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _well_conditioned(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (w, x, y, z) of the same ellipsoids with w at least 1/2.

    Readers compute w as sqrt(1 - x^2 - y^2 - z^2), which 8 bits cannot carry near w = 0. Half a turn about one of its
    own axes leaves an ellipsoid unchanged, and multiplies the quaternion by i, j or k: one of the four has a large w.
    """
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    same = np.stack([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])  # q, q i, q j, q k
    best = np.abs(same[:, 0]).argmax(0)
    chosen = same[best, :, np.arange(len(quats))]
    return chosen * np.where(chosen[:, :1] < 0, -1, 1)


FORMAT = Format(
    suffixes=(".spz",), options=(*TIME_STEP_OPTIONS, "canonical"), files=files, default_axes="opengl", holds="Gaussians"
)
