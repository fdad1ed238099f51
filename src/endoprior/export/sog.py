"""SOG version 2 of PlayCanvas: a zip archive of images with one pixel per Gaussian; no direction-dependent color.

Read by SuperSplat, PlayCanvas and splat-transform, in the axes of a PLY file. Source: https://developer.playcanvas.com
(The SOG Format).
"""

from __future__ import annotations

import io
import json
import math
from typing import Any
from zipfile import ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray
from PIL.Image import fromarray

from ..core.types import Splats
from ..model.scene import Scene
from .compressed_ply import in_bits, ordered, smallest_three
from .formats import TIME_STEP_OPTIONS, Format
from .options import ExportOptions
from .time_steps import TimeStep

FIRST_ALPHA = 252
"""Alpha of a rotation whose largest part is w; one more for x, y, z."""


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The .sog file of one time step."""
    return {".sog": encode_sog(step.plain_splats(scene, options.frame))}


def encode_sog(splats: Splats) -> bytes:
    """All Gaussians along a curve that keeps neighbors together, equal bytes for equal input.

    Position: 16 bits for sign(x) ln(|x| + 1) between the ends of each axis. Log scale and mean color: one of 256 equal
    steps. Opacity: 8 bits. Rotation: as in `smallest_three`, 8 bits.

    Raises:
        InputError: a position is not finite.
    """
    means, log_scales, quats, opacities, sh = ordered(splats, "sog")
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    steps = in_bits((logs - low) / np.maximum(high - low, 1e-9), 16)
    (scales, of_scale), (colors, of_color) = _by_codebook(log_scales), _by_codebook(sh[:, 0])
    largest, others = smallest_three(quats, 8)
    images = {
        "means_l": steps & 255,
        "means_u": steps >> 8,
        "scales": scales,
        "quats": np.column_stack([others, FIRST_ALPHA + largest]),
        "sh0": np.column_stack([colors, in_bits(opacities, 8)]),
    }
    about: dict[str, Any] = {"version": 2, "asset": {"generator": "endoprior"}, "count": len(means), "antialias": False}
    about["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    about["scales"] = {"codebook": of_scale.tolist(), "files": ["scales.webp"]}
    about["quats"] = {"files": ["quats.webp"]}
    about["sh0"] = {"codebook": of_color.tolist(), "files": ["sh0.webp"]}
    file = io.BytesIO()
    with ZipFile(file, "w") as archive:  # `ZipInfo` dates all files 1980; images are compressed as they are
        archive.writestr(ZipInfo("meta.json"), json.dumps(about, allow_nan=False))
        for name, values in images.items():
            archive.writestr(ZipInfo(f"{name}.webp"), _webp(values))
    return file.getvalue()


def _by_codebook(values: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The 8-bit place of each value in 256 equal steps, and these."""
    low, high = values.min(), values.max()
    return in_bits((values - low) / max(high - low, 1e-9), 8), np.linspace(low, high, 256).round(6)


def _webp(values: NDArray[np.int64]) -> bytes:
    """(N, 3 or 4) bytes as the pixels of a lossless image about as high as wide, row by row."""
    width = 4 * math.ceil(math.sqrt(len(values)) / 4)
    pixels = np.zeros((math.ceil(len(values) / width), width, values.shape[1]), np.uint8)
    pixels.reshape(-1, values.shape[1])[: len(values)] = values
    file = io.BytesIO()
    fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


FORMAT = Format(suffixes=(".sog",), options=(*TIME_STEP_OPTIONS, "canonical"), files=files, holds="Gaussians")
