"""PLY in the layout of 3D Gaussian splatting, and the PLY file that point clouds and meshes share.

Source of the layout: the files that 3DGS writes (Kerbl et al. 2023); of the file format: Turk, "The PLY Polygon File
Format", 1994. `K` spherical-harmonic coefficients per channel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import length_unit
from ..core.types import Splats
from ..model.scene import Scene
from .formats import TIME_STEP_OPTIONS, Axes, Format
from .options import ExportOptions
from .time_steps import TimeStep

LEAST_OPACITY = 1e-7
"""Opacities are clipped to this distance from 0 and 1, because their logits would be infinite."""
_TYPES = {"<f4": "float", "u1": "uchar", "<i4": "int"}


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The PLY file of one time step."""
    unit = length_unit(scene.lengths_are_relative)
    return {".ply": encode_ply(step.plain_splats(scene, options.frame), options.frame, unit, when(scene, step))}


def when(scene: Scene, step: TimeStep) -> str:
    """The comment of a PLY file on its time; no other file may lie beside it (`has_index`)."""
    words = [f"{name} {value}" for name, value in step.facts().items() if value is not None] or ["canonical"]
    words += [f"frames_per_second {scene.frames_per_second:g}"] if scene.frames_per_second else []
    return ", ".join(words)


def encode_ply(splats: Splats, axes: Axes = "opencv", unit: str = "mm", comment: str = "") -> bytes:
    """Binary PLY with one vertex per Gaussian, all properties float32. Args: comment: on the time.

    x y z (mm), nx ny nz (0), f_dc_0..2, f_rest_0.. (all of red, then green, then blue, each in the order of
    docs/format.md), opacity (logit), scale_0..2 (log of mm), rot_0..3 (w, x, y, z, of length 1).
    """
    sh = splats.sh.numpy()
    quats = splats.quats.numpy().astype(np.float64)
    opacities = splats.opacities.numpy().astype(np.float64).clip(LEAST_OPACITY, 1 - LEAST_OPACITY)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1)
    columns = {name: splats.means.numpy()[:, i] for i, name in enumerate("xyz")}
    columns |= {name: np.zeros(len(sh)) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{i}": sh[:, 0, i] for i in range(3)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns["opacity"] = np.log(opacities / (1 - opacities))
    columns |= {f"scale_{i}": np.log(splats.scales.numpy()[:, i].clip(1e-30)) for i in range(3)}
    rotations = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    columns |= {f"rot_{i}": rotations[:, i] for i in range(4)}
    return ply_bytes(vertex_table(columns), axes, unit, comment=comment)


def vertex_table(columns: dict[str, NDArray]) -> NDArray:
    """Structured array of equally long columns; 8-bit stays 8-bit, everything else becomes float32."""
    kinds = [(name, "u1" if column.dtype == np.uint8 else "<f4") for name, column in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), kinds)
    for name, column in columns.items():
        table[name] = column
    return table


def ply_bytes(
    vertices: NDArray, axes: Axes, unit: str, triangles: NDArray[np.int32] | None = None, comment: str = ""
) -> bytes:
    """A little-endian binary PLY file.

    Args:
        vertices: structured array, one field per property.
        axes: named in a comment; `SPACE=LPS` or `SPACE=RAS` is what 3D Slicer looks for.
        unit: of lengths, named in the same comment.
        triangles: (F, 3) vertex numbers.
        comment: one more line of text.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"comment axes {axes}, unit {unit}"]
    lines += [f"comment {comment}"] if comment else []
    lines += [f"comment SPACE={axes.upper()}"] if axes in ("lps", "ras") else []
    lines += [f"element vertex {len(vertices)}"]
    lines += [f"property {_TYPES[vertices.dtype[name].str.lstrip('|')]} {name}" for name in vertices.dtype.names]
    body = vertices.tobytes()
    if triangles is not None:
        lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, triangles
        body += faces.tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + body


FORMAT = Format(
    suffixes=(".ply",),
    options=(*TIME_STEP_OPTIONS, "canonical"),
    files=files,
    holds="Gaussians",
    has_index=False,  # SuperSplat plays a folder as a sequence only if it holds nothing else
)
