"""Binary glTF 2.0 with KHR_gaussian_splatting; programs without the extension show a colored point cloud.

Sources: the glTF 2.0 specification, and extensions/2.0/Khronos/KHR_gaussian_splatting in github.com/KhronosGroup/glTF
as ratified in 2026 (linear scales, linear opacities, quaternions x, y, z, w). glTF counts meters: a node scales the mm
of the data by 0.001.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.types import Splats
from ..model.gaussians import SH_C0
from ..model.scene import Scene
from .formats import TIME_STEP_OPTIONS, Format
from .options import ExportOptions
from .time_steps import TimeStep

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _POINTS, _VERTEX_BUFFER = 5126, 0, 34962
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The .glb file of one time step."""
    extras = {"unit": "mm", "axes": options.frame, "time": step.time}
    return {".glb": encode_glb(step.splats(scene, options.frame), extras)}


def encode_glb(splats: Splats, extras: dict[str, Any] | None = None) -> bytes:
    """One scene, one node, one primitive of POINTS.

    Args:
        extras: `extras` of the file's `asset`.
    """
    attributes = splat_attributes(splats)
    views, accessors, offset = [], [], 0
    for name, values in attributes.items():
        view = {"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": _VERTEX_BUFFER}
        kind = _KINDS[1 if values.ndim == 1 else values.shape[1]]
        accessor = {"bufferView": len(views), "componentType": _FLOAT, "count": len(values), "type": kind}
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        views.append(view)
        accessors.append(accessor)
        offset += values.nbytes
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": {name: i for i, name in enumerate(attributes)}, "mode": _POINTS}
    document = {
        "asset": {"version": "2.0", "generator": "endoprior", "extras": extras or {}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": [0.001, 0.001, 0.001]}],
        "meshes": [{"primitives": [primitive | {"extensions": {EXTENSION: kernel}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    return glb_bytes(document, b"".join(values.tobytes() for values in attributes.values()))


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


def decoded_srgb(encoded: NDArray) -> NDArray:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def glb_bytes(document: dict[str, Any], binary: bytes) -> bytes:
    """The container: header, a JSON chunk padded with spaces, a binary chunk padded with zeros, both to 4 bytes."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    chunks = b""
    for kind, content, filler in ((b"JSON", text, b" "), (b"BIN\0", binary, b"\0")):
        content += filler * (-len(content) % 4)
        chunks += struct.pack("<I4s", len(content), kind) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


FORMAT = Format(suffixes=(".glb",), options=(*TIME_STEP_OPTIONS, "canonical"), files=files, default_axes="opengl")
