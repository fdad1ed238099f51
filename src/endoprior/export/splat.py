"""The .splat format of antimatter15's viewer: 32 bytes per Gaussian, no header, no direction-dependent color.

Source: https://github.com/antimatter15/splat.
"""

from __future__ import annotations

import numpy as np

from ..core.types import Splats
from ..model.gaussians import SH_C0
from ..model.scene import Scene
from .formats import TIME_STEP_OPTIONS, Format
from .options import ExportOptions
from .time_steps import TimeStep

RECORD = np.dtype([("center", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""Center (mm), standard deviations (mm), color and opacity (0..255), quaternion w, x, y, z (128 + 128 q)."""


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The .splat file of one time step."""
    return {".splat": encode_splat(step.plain_splats(scene, options.frame))}


def encode_splat(splats: Splats) -> bytes:
    """Records sorted by opacity times volume, largest first, so that a viewer can show a file while it loads."""
    scales, opacities = splats.scales.numpy(), splats.opacities.numpy()
    order = np.argsort(-scales.prod(1) * opacities, kind="stable")
    rgba = np.column_stack([splats.sh.numpy()[:, 0] * SH_C0 + 0.5, opacities])
    quats = splats.quats.numpy()
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    records = np.empty(len(scales), RECORD)
    records["center"], records["scale"] = splats.means.numpy(), scales
    records["rgba"] = np.rint(rgba * 255).clip(0, 255)
    records["rotation"] = np.rint(unit * 128 + 128).clip(0, 255)
    return records[order].tobytes()


FORMAT = Format(suffixes=(".splat",), options=(*TIME_STEP_OPTIONS, "canonical"), files=files, holds="Gaussians")
