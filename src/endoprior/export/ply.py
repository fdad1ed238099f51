"""PLY files: Gaussians in the layout of 3D Gaussian splatting, colored points, and what every PLY file shares.

Source of the layout: the files that 3DGS writes (Kerbl et al. 2023); of the file format: Turk, "The PLY Polygon File
Format", 1994.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.types import Splats
from ..model.scene import Scene
from ..render import sh as harmonics
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Axes, ExportFormat, ExportOptions
from .time_steps import TimeStep

MIN_OPACITY = 1e-7
"""Opacities are clipped to this distance from 0 and 1, because their logits would be infinite."""


def gaussians(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The Gaussians of one time step."""
    splats, unit = step.plain_splats(scene, options.axes), length_unit(scene.lengths_are_relative)
    return {".ply": encode_ply(splats, options.axes, unit, when(scene, step))}


def when(scene: Scene, step: TimeStep) -> str:
    """The comment of a PLY file on its time; no other file may lie beside it (`has_index`)."""
    words = ["canonical"] if step.canonical else [f"{name} {value}" for name, value in step.facts().items()]
    words += [f"frames_per_second {scene.frames_per_second:g}"] if scene.frames_per_second else []
    return ", ".join(words)


def encode_ply(splats: Splats, axes: Axes = "opencv", unit: str = "mm", comment: str = "") -> bytes:
    """Binary PLY with one vertex per Gaussian, all properties float32.

    x y z (mm), nx ny nz (0), f_dc_0..2, f_rest_0.. (all of red, then green, then blue, each in the order of
    docs/format.md), opacity (logit), scale_0..2 (log of mm), rot_0..3 (w, x, y, z, of length 1).
    """
    sh = splats.sh.numpy()
    opacities = splats.opacities.numpy().astype(np.float64).clip(MIN_OPACITY, 1 - MIN_OPACITY)
    columns = _numbered("xyz", splats.means.numpy()) | dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(sh)))
    columns |= _numbered("f_dc_", sh[:, 0]) | _numbered("f_rest_", sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1))
    columns["opacity"] = np.log(opacities / (1 - opacities))
    columns |= _numbered("scale_", np.log(splats.scales.numpy().clip(1e-30)))
    columns |= _numbered("rot_", unit_quaternions(splats.quats.numpy().astype(np.float64)))
    return ply_bytes(columns, axes, unit, comment=comment)


def decode_ply(data: bytes) -> Splats:
    """The Gaussians of `encode_ply`."""
    vertices = ply_elements(data)["vertex"]

    def columns(*names: str) -> NDArray[np.float32]:
        return np.stack([vertices[name] for name in names], 1)

    rest = [name for name in vertices.dtype.names or () if name.startswith("f_rest_")]
    higher = np.stack([vertices[name] for name in rest], 1) if rest else np.zeros((len(vertices), 0))
    higher = higher.reshape(len(vertices), 3, len(rest) // 3).transpose(0, 2, 1)
    return splats_of(
        means=columns(*"xyz"),
        quats=columns(*(f"rot_{i}" for i in range(4))),
        scales=np.exp(columns(*(f"scale_{i}" for i in range(3)))),
        opacities=1 / (1 + np.exp(-vertices["opacity"].astype(np.float64))),
        sh=np.concatenate([columns(*(f"f_dc_{i}" for i in range(3)))[:, None], higher], 1),
    )


def splats_of(**values: NDArray) -> Splats:
    """`Splats` of what a file holds, activated."""
    return Splats(**{name: torch.from_numpy(np.array(value, np.float32, order="C")) for name, value in values.items()})


def ply_elements(data: bytes) -> dict[str, NDArray]:
    """The elements of a binary PLY file of ours without lists, each an array with the names of its properties."""
    header, body = data.split(b"end_header\n", 1)
    kinds = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in map(str.split, header.decode().splitlines()):
        if words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            elements[-1][2].append((words[2], kinds[words[1]]))
    found, at = {}, 0
    for name, count, properties in elements:
        found[name] = np.frombuffer(body, properties, count, at)
        at += found[name].nbytes
    return found


def unit_quaternions(quats: NDArray) -> NDArray:
    """(N, 4) quaternions scaled to length 1."""
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def points(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The centers of the Gaussians that are opaque enough, in the colors that the frame's camera sees.

    Raises:
        InputError: no Gaussian is that opaque.
    """
    splats = step.splats(scene, "opencv")
    opaque = splats.opacities >= options.min_opacity
    if not opaque.any():
        want = f"at most {float(splats.opacities.max()):.3f}, the largest opacity"
        raise input_error("--min-opacity", want, f"{options.min_opacity}", "lower it.")
    means = splats.means[opaque]
    towards = torch.nn.functional.normalize(means - torch.from_numpy(step.camera(scene).center).to(means.dtype))
    colors = np.rint(harmonics.colors(splats.sh[opaque], towards).numpy().clip(0, 1) * 255).astype(np.uint8)
    columns = colored(points_in_axes(means.numpy(), options.axes), colors)
    return {".ply": ply_bytes(columns, options.axes, length_unit(scene.lengths_are_relative))}


def colored(positions: NDArray, colors: NDArray[np.uint8]) -> dict[str, NDArray]:
    """The properties of points (P, 3) with colors (P, 3), 0..255."""
    return _numbered("xyz", positions) | dict(zip(("red", "green", "blue"), colors.T, strict=True))


def _numbered(name: str, values: NDArray) -> dict[str, NDArray]:
    """The columns of an array by the letters of `name`, or by a name that ends in `_` and their number."""
    names = [f"{name}{i}" for i in range(values.shape[1])] if name.endswith("_") else name
    return dict(zip(names, values.T, strict=True))


def ply_bytes(
    columns: Mapping[str, NDArray], axes: Axes, unit: str, triangles: NDArray[np.int32] | None = None, comment: str = ""
) -> bytes:
    """A little-endian binary PLY file.

    Args:
        columns: equally long properties of the vertices; 8-bit stays 8-bit, everything else becomes float32.
        axes: named in a comment; `SPACE=LPS` or `SPACE=RAS` is what 3D Slicer looks for.
        triangles: (F, 3) vertex numbers.
        comment: one more line of text.
    """
    kinds = [(name, "u1" if column.dtype == np.uint8 else "<f4") for name, column in columns.items()]
    vertices = np.empty(len(next(iter(columns.values()))), kinds)
    for name, column in columns.items():
        vertices[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"comment axes {axes}, unit {unit}"]
    lines += [f"comment {comment}"] if comment else []
    lines += [f"comment SPACE={axes.upper()}"] if axes in ("lps", "ras") else []
    lines += [f"element vertex {len(vertices)}"]
    lines += [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in kinds]
    body = vertices.tobytes()
    if triangles is not None:
        lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, triangles
        body += faces.tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + body


GAUSSIAN_OPTIONS = (*TIME_STEP_OPTIONS, "canonical")
PLY = ExportFormat(
    suffixes=(".ply",),
    options=GAUSSIAN_OPTIONS,
    files=gaussians,
    holds="Gaussians",
    read=decode_ply,
    has_index=False,  # SuperSplat plays a folder as a sequence only if it holds nothing else
)
POINTS = ExportFormat((".ply",), (*GAUSSIAN_OPTIONS, "min_opacity"), points, holds="colored points")
