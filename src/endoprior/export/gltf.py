"""Binary glTF 2.0 with KHR_gaussian_splatting; programs without the extension show a colored point cloud.

Source: extensions/2.0/Khronos/KHR_gaussian_splatting in github.com/KhronosGroup/glTF as ratified in 2026 (linear
scales, linear opacities, quaternions x, y, z, w). glTF counts meters: a node scales the mm of the data by 0.001.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import length_unit
from ..core.types import Splats
from ..model.gaussians import SH_C0
from ..model.scene import Scene
from .formats import TIME_STEP_OPTIONS, Format
from .glb import MM_TO_METERS, VERTEX_BUFFER, Buffer, decoded_srgb
from .options import ExportOptions
from .time_steps import TimeStep

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The .glb file of one time step."""
    extras = {"unit": length_unit(scene.lengths_are_relative), "axes": options.frame, "time": step.time}
    return {".glb": encode_glb(step.plain_splats(scene, options.frame), extras)}


def encode_glb(splats: Splats, extras: dict[str, Any] | None = None) -> bytes:
    """One scene, one node, one primitive of POINTS.

    Args:
        extras: `extras` of the file's `asset`.
    """
    buffer = Buffer()
    numbers = {
        name: buffer.add(values, VERTEX_BUFFER, bounds=name == "POSITION")
        for name, values in splat_attributes(splats).items()
    }
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": numbers, "mode": _POINTS, "extensions": {EXTENSION: kernel}}
    document = {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": MM_TO_METERS}],
        "meshes": [{"primitives": [primitive]}],
    }
    return buffer.file(document, extras or {})


def splat_attributes(splats: Splats) -> dict[str, NDArray[np.float32]]:
    """Vertex attributes by semantic: positions and scales in mm, the color of the fallback in linear light."""
    quats = splats.quats.numpy().astype(np.float64)
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    sh, opacities = splats.sh.numpy(), splats.opacities.numpy()
    linear = decoded_srgb(np.clip(sh[:, 0] * SH_C0 + 0.5, 0, 1))
    attributes = {
        "POSITION": splats.means.numpy(),
        "COLOR_0": np.column_stack([linear, opacities]),
        f"{EXTENSION}:ROTATION": unit[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": splats.scales.numpy(),
        f"{EXTENSION}:OPACITY": opacities,
    }
    for k in range(sh.shape[1]):
        band = int(np.sqrt(k))
        attributes[f"{EXTENSION}:SH_DEGREE_{band}_COEF_{k - band * band}"] = sh[:, k]
    return {name: np.ascontiguousarray(values, "<f4") for name, values in attributes.items()}


FORMAT = Format(
    suffixes=(".glb",), options=(*TIME_STEP_OPTIONS, "canonical"), files=files, default_axes="opengl", holds="Gaussians"
)
