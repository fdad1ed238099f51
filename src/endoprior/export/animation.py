"""The moving tissue surface as one animated mesh in binary glTF 2.0, for Blender and other 3D programs.

The mesh of the first time step is carried by the Gaussians, so that each vertex is one material point. Morph target i
displaces every vertex to where it is at time step i + 1; the animation fades from each target to the next.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import length_unit
from ..model.carry import carry_points
from ..model.scene import Scene
from ..system.atomic import whole_file
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Format, Progress
from .glb import INDEX_BUFFER, MM_TO_METERS, VERTEX_BUFFER, Buffer, decoded_srgb
from .mesh import SURFACE_OPTIONS, surface_mesh
from .options import ExportOptions
from .time_steps import seconds_of_motion, selected_time_steps

UNLIT = "KHR_materials_unlit"
"""Vertex colors are those of the video, the endoscope's light included; viewers must not light them again."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the .glb file.

    Raises:
        InputError: there are fewer than two time steps, they do not increase, or the first shows no surface.
    """
    steps = selected_time_steps(scene, options)
    seconds = seconds_of_motion(scene, steps)
    mesh = surface_mesh(scene, steps[0], options)
    at_first = np.zeros(len(mesh.vertices), np.intp)
    carried = carry_points(scene, mesh.vertices, at_first, [step.time for step in steps])
    positions = points_in_axes(carried, options.frame)
    names = [step.name for step in steps]
    relative = scene.lengths_are_relative
    extras = {"unit": length_unit(relative), "axes": options.frame, "lengths_are_relative": relative}
    with whole_file(out) as temporary:
        temporary.write_bytes(encode_animation(positions, mesh.triangles, mesh.colors, seconds, names, extras))
    progress(1, 1)


def blender_note(scene: Scene, out: Path, options: ExportOptions) -> str:
    """How to open `out` in Blender: glTF cannot tell it the rate and the range of the frames to play."""
    seconds = seconds_of_motion(scene, selected_time_steps(scene, options))
    rate = max(round(scene.frames_per_second), 1)
    first, last = math.floor(seconds[0] * rate + 1e-6), math.ceil(seconds[-1] * rate - 1e-6)
    code = f"s = bpy.context.scene; s.render.fps = {rate}; s.frame_start = {first}; s.frame_end = {last}; "
    code += f"bpy.ops.import_scene.gltf(filepath={str(out.absolute())!r})"
    return f"a .glb file does not say which frames to play. In Blender's Python console, type: {code}"


def encode_animation(
    positions: NDArray[np.float32],
    triangles: NDArray[np.int32],
    colors: NDArray[np.uint8],
    seconds: list[float],
    names: list[str],
    extras: dict[str, object],
) -> bytes:
    """A .glb file with one mesh whose vertices move.

    Args:
        positions: (T, V, 3) mm. triangles: (F, 3) vertex numbers. colors: (V, 3) sRGB, 0..255.
        seconds: T increasing times. names: T names of the time steps.
        extras: `extras` of the file's `asset`.
    """
    buffer = Buffer()
    attributes = {
        "POSITION": buffer.add(positions[0], VERTEX_BUFFER, bounds=True),
        "COLOR_0": buffer.add(decoded_srgb(colors / 255).astype(np.float32), VERTEX_BUFFER),
    }
    indices = buffer.add(triangles.astype(np.uint32).ravel(), INDEX_BUFFER)
    targets = [{"POSITION": buffer.add(there - positions[0], VERTEX_BUFFER, bounds=True)} for there in positions[1:]]
    weights = np.eye(len(seconds), dtype=np.float32)[:, 1:]  # of every target at every time; the first is the mesh
    sampler = {
        "input": buffer.add(np.array(seconds, np.float32), bounds=True),
        "output": buffer.add(weights.ravel()),
        "interpolation": "LINEAR",
    }
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    primitive = {"attributes": attributes, "indices": indices, "targets": targets, "material": 0}
    mesh = {"name": "tissue", "primitives": [primitive], "extras": {"targetNames": names[1:]}}
    document = {
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "tissue", "mesh": 0, "scale": MM_TO_METERS}],
        "meshes": [mesh],
        "materials": [{"name": "tissue", "doubleSided": True, "extensions": {UNLIT: {}}}],
        "animations": [{"name": "motion", "samplers": [sampler], "channels": [channel]}],
    }
    return buffer.file(document, extras)


FORMAT = Format(
    suffixes=(".glb",),
    options=(*TIME_STEP_OPTIONS, *SURFACE_OPTIONS),
    write=write,
    default_axes="opengl",
    holds="a moving mesh",
    note=blender_note,
)
