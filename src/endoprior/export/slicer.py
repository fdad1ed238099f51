"""The moving tissue surface as a scene that 3D Slicer plays: one .mrb file.

A .mrb file is a zip archive of a scene and its data. This scene holds a sequence, itself an archive of the same kind
with one mesh per time step, a browser that plays it, and the model that the browser shows.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import BinaryIO
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.types import Camera
from ..model.scene import Scene
from ..system.atomic import whole_file
from .axes import points_in_axes
from .formats import Format, Progress
from .mesh import SURFACE_OPTIONS, Mesh, surface_mesh
from .mesh_files import encode_mesh
from .mrml import SlicerScene
from .options import ExportOptions
from .time_steps import seconds_of_motion, selected_time_steps

FOLDER = "tissue"
"""Folder in each archive, and name of the scene in it."""
MODEL_FILE, SEQUENCE_FILE = "Data/tissue.ply", "Data/tissue.seq.mrb"
IN_MEMORY_BYTES = 2**28
"""A larger sequence waits in a temporary file."""
VIEW_ANGLE = 30.0
"""Vertical angle of Slicer's 3D view, degrees."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the .mrb file.

    Raises:
        InputError: there are fewer than two time steps, they do not increase, one shows no surface, or Slicer would
            mistake `out` for a bare sequence.
    """
    if out.name.lower().endswith(".seq.mrb"):  # Slicer chooses the reader by the name
        want, fix = "a name that does not end in .seq.mrb", f"use {out.name[:-8]}.mrb."
        raise input_error(out, want, "one", fix)
    steps = selected_time_steps(scene, options)
    seconds = seconds_of_motion(scene, steps)
    meshes = (surface_mesh(scene, step, options) for step in steps)
    unit = length_unit(scene.lengths_are_relative)
    with whole_file(out) as temporary, tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES) as sequence:
        first = next(meshes)
        _write_sequence(sequence, chain([first], meshes), unit, seconds, progress)
        with ZipFile(temporary, "w") as archive:
            _put(archive, f"{FOLDER}.mrml", _scene_text(first, steps[0].camera(scene), seconds))
            _put(archive, MODEL_FILE, _ply(first, unit))
            entry = _entry(SEQUENCE_FILE)  # stored as it is: its files are compressed
            entry.file_size = sequence.tell()
            sequence.seek(0)
            with archive.open(entry, "w") as stored:
                shutil.copyfileobj(sequence, stored)


def _write_sequence(
    file: BinaryIO, meshes: Iterable[Mesh], unit: str, seconds: list[float], progress: Progress
) -> None:
    """Write the archive of a sequence: one model for each time step, and an index of them."""
    scene = SlicerScene()
    with ZipFile(file, "w") as archive:
        for k, mesh in enumerate(meshes):
            name = f"Data/tissue_{k}.ply"
            _put(archive, name, _ply(mesh, unit))
            scene.add_model(name)
            progress(k + 1, len(seconds))
        scene.add("Sequence", "tissue", singleton="SequenceIndex", **_index(seconds))
        _put(archive, f"{FOLDER}.mrml", scene.file())


def _scene_text(first: Mesh, camera: Camera, seconds: list[float]) -> bytes:
    """The scene that Slicer opens, with the first mesh shown."""
    scene = SlicerScene()
    scene.add("Camera", "Camera", singleton="1", **_view(first, camera))
    display = scene.add(
        "ModelDisplay",
        "display",
        scalarVisibility="true",
        activeScalarName="RGB",  # the name that VTK gives the colors of a PLY file
        activeAttributeLocation="point",
        scalarRangeFlag="UseDirectMapping",
        ambient="1",  # colors are those of the video, the endoscope's light included: do not light them again
        diffuse="0",
        backfaceCulling="false",
    )
    model = scene.add_model(MODEL_FILE, {"display": display})
    storage = scene.add("SequenceStorage", "storage", fileName=SEQUENCE_FILE)
    attributes = {"attributes": "DataNodeClassName:vtkMRMLModelNode", **_index(seconds)}
    sequence = scene.add("Sequence", "tissue", {"storage": storage}, **attributes)
    scene.add(
        "SequenceBrowser",
        "tissue",
        {"sequenceNodeRef0": sequence, "dataNodeRef0": model},
        virtualNodePostfixes="0",
        SynchronizationPropertiesMap0="playback true recording false overwriteProxyName false saveChanges false",
        playbackRateFps=f"{(len(seconds) - 1) / (seconds[-1] - seconds[0]):.6g}",
        playbackLooped="true",
        selectedItemNumber="0",
    )
    return scene.file()


def _index(seconds: list[float]) -> dict[str, str]:
    """What says at which second each model of the sequence is shown."""
    models = (f"vtkMRMLModelNode{k + 1}:{second:.9g}" for k, second in enumerate(seconds))
    return {
        "indexName": "time",
        "indexUnit": "s",
        "indexType": "numeric",
        "numericIndexValueTolerance": f"{np.diff(seconds).min() / 10:.3g}",
        "indexValues": ";".join(models),
    }


def _view(mesh: Mesh, camera: Camera) -> dict[str, str]:
    """Slicer's 3D view at the start: along the endoscope's axis, the mesh filling the image; RAS axes, mm."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    focus, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    _right, down, forward = camera.world_to_camera[:3, :3]
    position = focus - forward * radius / np.sin(np.deg2rad(VIEW_ANGLE / 2))
    places = {"position": position, "focalPoint": focus, "viewUp": -down}
    return {name: " ".join(f"{x:.6g}" for x in points_in_axes(place, "ras")) for name, place in places.items()}


def _ply(mesh: Mesh, unit: str) -> bytes:
    return encode_mesh(points_in_axes(mesh.vertices, "lps"), mesh.triangles, mesh.colors, "ply", "lps", unit)


def _put(archive: ZipFile, name: str, content: bytes) -> None:
    archive.writestr(_entry(name), content, ZIP_DEFLATED)


def _entry(name: str) -> ZipInfo:
    """A file of an archive; `ZipInfo` dates all of them 1980, so equal scenes give equal bytes."""
    return ZipInfo(f"{FOLDER}/{name}")


FORMAT = Format(
    suffixes=(".mrb",), options=("times", "split", *SURFACE_OPTIONS), write=write, holds="a sequence of meshes"
)
