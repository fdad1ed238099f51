"""Binary glTF 2.0: Gaussians with KHR_gaussian_splatting, and the moving tissue surface as one animated mesh.

Sources: the glTF 2.0 specification, and extensions/2.0/Khronos/KHR_gaussian_splatting in github.com/KhronosGroup/glTF
as ratified in 2026 (linear scales, linear opacities, quaternions x, y, z, w); programs without the extension show a
colored point cloud. glTF counts meters: a node scales the mm of the data by 0.001.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import length_unit
from ..core.types import Splats
from ..model.carry import carry_points
from ..model.gaussians import SH_C0
from ..model.scene import Scene
from ..system.atomic import whole_file
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, ExportFormat, ExportOptions, Progress
from .mesh import SURFACE_OPTIONS, surface_mesh
from .ply import GAUSSIAN_OPTIONS, splats_of, unit_quaternions
from .time_steps import TimeStep, seconds_of_motion, selected_time_steps

SPLATTING = "KHR_gaussian_splatting"
UNLIT = "KHR_materials_unlit"
"""Vertex colors are those of the video, the endoscope's light included; viewers must not light them again."""
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
_COMPONENTS = {"<f4": 5126, "<u4": 5125}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_POINTS = 0


class Buffer:
    """The arrays of a file, one after the other; others refer to them by the number of their accessor."""

    def __init__(self) -> None:
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, int]] = []
        self._contents = bytearray()

    def add(self, values: NDArray, target: int | None = None, *, bounds: bool = False) -> int:
        """Append float32 or uint32 `values`, (count,) or (count, 3 or 4), and return the number of their accessor.

        Args:
            target: VERTEX_BUFFER, INDEX_BUFFER or neither.
            bounds: also store minimum and maximum, as positions and times of keyframes must.
        """
        columns = values.reshape(len(values), -1)
        accessor = {"bufferView": len(self._views), "componentType": _COMPONENTS[values.dtype.str]}
        accessor |= {"count": len(columns), "type": _KINDS[columns.shape[1]]}
        if bounds:
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        view = {"buffer": 0, "byteOffset": len(self._contents), "byteLength": values.nbytes}
        self._views.append(view | ({} if target is None else {"target": target}))
        self._accessors.append(accessor)
        self._contents += values.tobytes()
        return len(self._accessors) - 1

    def file(
        self, extension: str, node: dict[str, Any], mesh: dict[str, Any], extras: dict[str, Any], **document: Any
    ) -> bytes:
        """The bytes of a .glb file: a header, a JSON chunk and a binary chunk, both padded to 4 bytes.

        Args:
            extension: which readers should know. node, mesh: the only ones, in mm.
            extras: `extras` of its `asset`. document: what else it holds.
        """
        document = {
            "asset": {"version": "2.0", "generator": "endoprior", "extras": extras},
            "extensionsUsed": [extension],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [node | {"mesh": 0, "scale": [0.001] * 3}],
            "meshes": [mesh],
            **document,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._contents)}],
        }
        text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
        chunks = b""
        for kind, content, filler in ((b"JSON", text, b" "), (b"BIN\0", self._contents, b"\0")):
            padding = filler * (-len(content) % 4)
            chunks += struct.pack("<I4s", len(content) + len(padding), kind) + content + padding
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def decoded_srgb(encoded: NDArray) -> NDArray:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


# Gaussians of one time step.


def gaussians(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """The .glb file of one time step."""
    unit = length_unit(scene.lengths_are_relative)
    extras = {"unit": unit, "axes": options.axes, "time": step.facts()["time"]}
    return {".glb": encode_glb(step.plain_splats(scene, options.axes), extras)}


def encode_glb(splats: Splats, extras: dict[str, Any]) -> bytes:
    """One primitive of POINTS: positions and scales in mm, the color of the fallback in linear light."""
    sh, opacities = splats.sh.numpy(), splats.opacities.numpy()
    attributes = {
        "POSITION": splats.means.numpy(),
        "COLOR_0": np.column_stack([decoded_srgb(np.clip(sh[:, 0] * SH_C0 + 0.5, 0, 1)), opacities]),
        f"{SPLATTING}:ROTATION": unit_quaternions(splats.quats.numpy().astype(np.float64))[:, [1, 2, 3, 0]],
        f"{SPLATTING}:SCALE": splats.scales.numpy(),
        f"{SPLATTING}:OPACITY": opacities,
    }
    for k in range(sh.shape[1]):
        band = int(np.sqrt(k))
        attributes[f"{SPLATTING}:SH_DEGREE_{band}_COEF_{k - band * band}"] = sh[:, k]
    buffer = Buffer()
    numbers = {
        name: buffer.add(np.ascontiguousarray(values, "<f4"), VERTEX_BUFFER, bounds=name == "POSITION")
        for name, values in attributes.items()
    }
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": numbers, "mode": _POINTS, "extensions": {SPLATTING: kernel}}
    return buffer.file(SPLATTING, {}, {"primitives": [primitive]}, extras)


def decode_glb(data: bytes) -> Splats:
    """The Gaussians of `encode_glb`."""
    (size,) = struct.unpack_from("<I", data, 12)
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    primitive = document["meshes"][0]["primitives"][0]

    def values(name: str) -> NDArray[np.float32]:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        return np.frombuffer(body, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(accessor["count"], -1)

    bands = [name for name in primitive["attributes"] if name.startswith(f"{SPLATTING}:SH_DEGREE_")]
    return splats_of(
        means=values("POSITION"),
        quats=values(f"{SPLATTING}:ROTATION")[:, [3, 0, 1, 2]],
        scales=values(f"{SPLATTING}:SCALE"),
        opacities=values(f"{SPLATTING}:OPACITY")[:, 0],
        sh=np.stack([values(name) for name in bands], 1),
    )


# The moving mesh. Carried by the Gaussians, each vertex is one material point. Morph target i displaces every vertex to
# where it is at time step i + 1; the animation fades from each target to the next.


def write_animation(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the .glb file.

    Raises:
        InputError: there are fewer than two time steps, they do not increase, or the first shows no surface.
    """
    steps = selected_time_steps(scene, options)
    seconds = seconds_of_motion(scene, steps)
    mesh = surface_mesh(scene, steps[0], options)
    at_first = np.zeros(len(mesh.vertices), np.intp)
    positions = points_in_axes(
        carry_points(scene, mesh.vertices, at_first, [step.time for step in steps]), options.axes
    )
    buffer = Buffer()
    attributes = {
        "POSITION": buffer.add(positions[0], VERTEX_BUFFER, bounds=True),
        "COLOR_0": buffer.add(decoded_srgb(mesh.colors / 255).astype(np.float32), VERTEX_BUFFER),
    }
    indices = buffer.add(mesh.triangles.astype(np.uint32).ravel(), INDEX_BUFFER)
    targets = [{"POSITION": buffer.add(there - positions[0], VERTEX_BUFFER, bounds=True)} for there in positions[1:]]
    weights = np.eye(len(seconds), dtype=np.float32)[:, 1:]  # of every target at every time; the first is the mesh
    sampler = {
        "input": buffer.add(np.array(seconds, np.float32), bounds=True),
        "output": buffer.add(weights.ravel()),
        "interpolation": "LINEAR",
    }
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    primitive = {"attributes": attributes, "indices": indices, "targets": targets, "material": 0}
    names, relative = {"targetNames": [step.name for step in steps[1:]]}, scene.lengths_are_relative
    content = buffer.file(
        UNLIT,
        {"name": "tissue"},
        # VTK moves only a mesh that has weights; they are optional.
        {"name": "tissue", "primitives": [primitive], "weights": [0.0] * len(targets), "extras": names},
        {"unit": length_unit(relative), "axes": options.axes, "lengths_are_relative": relative},
        materials=[{"name": "tissue", "doubleSided": True, "extensions": {UNLIT: {}}}],
        animations=[{"name": "motion", "samplers": [sampler], "channels": [channel]}],
    )
    with whole_file(out) as temporary:
        temporary.write_bytes(content)
    progress(1, 1)


def blender_note(scene: Scene, out: Path, options: ExportOptions) -> str:
    """How to open `out` in Blender: glTF cannot tell it the rate and the range of the frames to play."""
    seconds = seconds_of_motion(scene, selected_time_steps(scene, options))
    rate = max(round(scene.frames_per_second), 1)
    first, last = math.floor(seconds[0] * rate + 1e-6), math.ceil(seconds[-1] * rate - 1e-6)
    code = f"s = bpy.context.scene; s.render.fps = {rate}; s.frame_start = {first}; s.frame_end = {last}; "
    code += f"bpy.ops.import_scene.gltf(filepath={str(out.absolute())!r})"
    return f"a .glb file does not say which frames to play. In Blender's Python console, type: {code}"


GAUSSIANS = ExportFormat(
    (".glb",), GAUSSIAN_OPTIONS, gaussians, default_axes="opengl", holds="Gaussians", read=decode_glb
)
ANIMATION = ExportFormat(
    suffixes=(".glb",),
    options=(*TIME_STEP_OPTIONS, *SURFACE_OPTIONS),
    write=write_animation,
    default_axes="opengl",
    holds="a moving mesh",
    note=blender_note,
)
