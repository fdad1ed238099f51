"""The moving tissue surface, and points that move with it, as a scene that 3D Slicer plays: one .mrb file.

A .mrb file is a zip archive of a scene and its data. This scene holds a sequence of meshes and one of point lists,
each an archive of the same kind with one file per time step, a browser that plays them, and the nodes that it shows.
Source of the scene files (MRML): what the node classes of github.com/Slicer/Slicer read (`ReadXMLAttributes` in
Libs/MRML/Core, and vtkMRMLSequenceBrowserNode).
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from xml.etree.ElementTree import Element, indent, tostring
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..core.types import Camera
from ..model.carry import carry
from ..model.scene import Scene
from ..model.uncertainty import LEVEL, PointErrors, point_errors
from ..system.atomic import whole_file
from .axes import points_in_axes
from .formats import ExportFormat, ExportOptions, Progress
from .mesh import SURFACE_OPTIONS, Mesh, encode_mesh, surface_mesh
from .time_steps import TimeStep, seconds_of_motion, selected_time_steps
from .tracks import back_projected, read_query_points

FOLDER = "tissue"
"""Folder in each archive, and name of the scene in it."""
MARKUPS_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
"""Name of the format of point lists; Slicer takes files with this name."""
IN_MEMORY_BYTES = 2**28
"""A larger sequence waits in a temporary file."""
SCENE_VERSION = "Slicer4.4.0"
"""Version of the scene format, as in the scenes of Slicer's own tests."""
VIEW_ANGLE = 30.0
"""Vertical angle of Slicer's 3D view, degrees."""


@dataclass(frozen=True)
class Played:
    """What one sequence holds."""

    name: str
    suffix: str
    tag: str
    """Of its nodes."""
    storage: str
    display: str
    """Tags of their storage and display nodes, with the attributes of the latter in `look`."""
    look: Mapping[str, str]

    @property
    def first_file(self) -> str:
        """Name of the file of what is shown at the start."""
        return f"Data/{self.name}{self.suffix}"

    @property
    def sequence_file(self) -> str:
        """Name of the file of the sequence."""
        return f"Data/{self.name}.seq.mrb"


COLORED = {
    "scalarVisibility": "true",
    "activeScalarName": "RGB",  # the name that VTK gives the colors of a PLY file
    "activeAttributeLocation": "point",
    "scalarRangeFlag": "UseDirectMapping",
    "ambient": "1",  # colors are those of the video, the endoscope's light included: do not light them again
    "diffuse": "0",
    "backfaceCulling": "false",
}
LABELED = {"pointLabelsVisibility": "true"}
TISSUE = Played("tissue", ".ply", "Model", "ModelStorage", "ModelDisplay", COLORED)
POINTS = Played("points", ".mrk.json", "MarkupsFiducial", "MarkupsJsonStorage", "MarkupsDisplay", LABELED)


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the .mrb file.

    Raises:
        InputError: there are fewer than two time steps, they do not increase, one shows no surface, the points cannot
            be read or show no surface, or Slicer would mistake `out` for a bare sequence.
    """
    if out.name.lower().endswith(".seq.mrb"):  # Slicer chooses the reader by the name
        want, fix = "a name that does not end in .seq.mrb", f"use {out.name[:-8]}.mrb."
        raise input_error(out, want, "one", fix)
    steps = selected_time_steps(scene, options)
    seconds = seconds_of_motion(scene, steps)
    meshes = (surface_mesh(scene, step, options) for step in steps)
    first, unit = next(meshes), length_unit(scene.lengths_are_relative)
    surfaces = (encode_mesh(mesh, "ply", "lps", unit) for mesh in chain([first], meshes))
    files: list[tuple[Played, Iterable[bytes]]] = [(TISSUE, surfaces)]
    if options.points:
        positions, errors = _carried(scene, options.points, options.min_alpha, steps)
        texts = zip(errors.confidence, errors.across.half_width(LEVEL), errors.along(), strict=True)
        files.append((POINTS, (markups(*there, unit) for there in zip(positions, texts, strict=True))))
    with whole_file(out) as temporary, ZipFile(temporary, "w") as archive:
        start = _scene_text(first, steps[0].camera(scene), seconds, [played for played, _ in files])
        _put(archive, f"{FOLDER}.mrml", start)
        for played, contents in files:
            _put_sequence(archive, played, contents, seconds, progress)


def _carried(
    scene: Scene, file: Path, min_alpha: float, steps: list[TimeStep]
) -> tuple[NDArray[np.float32], PointErrors]:
    """(T, P, 3) positions, mm, and errors of the query points of a file at the time steps."""
    queries = read_query_points(file, scene)
    starts = back_projected(scene, queries, min_alpha)
    frames, own = np.unique(queries.frames, return_inverse=True)
    times = [*(frames / len(scene.cameras)), *(step.time for step in steps)]
    found, cameras = carry(scene, starts, own, times), scene.cameras
    shown_by = [min(round(time * len(cameras)), len(cameras) - 1) for time in times]
    later = slice(len(frames), None)
    return found.positions[later], point_errors(scene, found, own, shown_by).at(later)


def markups(positions: NDArray[np.float32], errors: tuple[NDArray, NDArray, NDArray], unit: str) -> bytes:
    """A .mrk.json file of (P, 3) positions in world axes, mm, labeled by their number in `tracks`.

    Args:
        errors: (P,) each: confidence, and half of the 95 % range across and along the ray of the camera, in `unit`.
    """
    points = [
        {
            "id": f"{k + 1}",
            "label": f"{k}",
            "description": f"confidence {share:.2f}; ±{across:.2f} {unit} across, ±{along:.2f} {unit} along the view",
            "position": place,
        }
        for k, (place, share, across, along) in enumerate(
            zip(points_in_axes(positions, "lps").tolist(), *errors, strict=True)
        )
    ]
    fiducials = {"type": "Fiducial", "coordinateSystem": "LPS", "locked": True, "controlPoints": points}
    return json.dumps({"@schema": MARKUPS_SCHEMA, "markups": [fiducials]}, allow_nan=False).encode()


def _put_sequence(
    archive: ZipFile, played: Played, contents: Iterable[bytes], seconds: list[float], progress: Progress
) -> None:
    """Add what is shown at the start, and the archive of a sequence: a node for each time step, and an index."""
    nodes: list[Element] = []
    with tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES) as sequence:
        with ZipFile(sequence, "w") as inner:
            for k, content in enumerate(contents, 1):
                if k == 1:
                    _put(archive, played.first_file, content)
                name = f"Data/{played.name}_{k - 1}{played.suffix}"
                _put(inner, name, content)
                nodes += _stored(played, k, name)
                progress(k, len(seconds))
            nodes.append(_node("Sequence", "SequenceIndex", played.name, _index(played, seconds)))
            _put(inner, f"{FOLDER}.mrml", _scene(nodes))
        entry = _entry(played.sequence_file)  # stored as it is: its files are compressed
        entry.file_size = sequence.tell()
        sequence.seek(0)
        with archive.open(entry, "w") as stored:
            shutil.copyfileobj(sequence, stored)


def _scene_text(first: Mesh, camera: Camera, seconds: list[float], played: list[Played]) -> bytes:
    """The scene that Slicer opens, with the first time step shown."""
    nodes, roles = [_node("Camera", "1", "Camera", _view(first, camera))], {}
    for k, each in enumerate(played):
        display = _node(each.display, 1, "display", each.look)
        stored = _stored(each, 1, each.first_file, display=display)
        storage = _node("SequenceStorage", k + 1, "storage", {"fileName": each.sequence_file})
        attributes = {"attributes": f"DataNodeClassName:vtkMRML{each.tag}Node"} | _index(each, seconds)
        sequence = _node("Sequence", k + 1, each.name, attributes, storage=storage)
        nodes += [display, *stored, storage, sequence]
        roles |= {f"sequenceNodeRef{k}": sequence, f"dataNodeRef{k}": stored[-1]}
    synchronization = "playback true recording false overwriteProxyName false saveChanges false"
    browser = {
        "virtualNodePostfixes": " ".join(str(k) for k in range(len(played))),
        "playbackRateFps": f"{(len(seconds) - 1) / (seconds[-1] - seconds[0]):.6g}",
        "playbackLooped": "true",
        "selectedItemNumber": "0",
    }
    browser |= {f"SynchronizationPropertiesMap{k}": synchronization for k in range(len(played))}
    return _scene([*nodes, _node("SequenceBrowser", 1, "tissue", browser, **roles)])


def _index(played: Played, seconds: list[float]) -> dict[str, str]:
    """What says at which second each node of the sequence is shown."""
    nodes = (f"vtkMRML{played.tag}Node{k + 1}:{second:.9g}" for k, second in enumerate(seconds))
    kind = {"indexName": "time", "indexUnit": "s", "indexType": "numeric"}
    tolerance = f"{np.diff(seconds).min() / 10:.3g}"
    return kind | {"numericIndexValueTolerance": tolerance, "indexValues": ";".join(nodes)}


def _view(mesh: Mesh, camera: Camera) -> dict[str, str]:
    """Slicer's 3D view at the start: along the endoscope's axis, the mesh filling the image; RAS axes, mm."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    focus, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    _right, down, forward = camera.world_to_camera[:3, :3]
    position = focus - forward * radius / np.sin(np.deg2rad(VIEW_ANGLE / 2))
    places = {"position": position, "focalPoint": focus, "viewUp": -down}
    return {name: " ".join(f"{x:.6g}" for x in points_in_axes(place, "ras")) for name, place in places.items()}


def _put(archive: ZipFile, name: str, content: bytes) -> None:
    archive.writestr(_entry(name), content, ZIP_DEFLATED)


def _entry(name: str) -> ZipInfo:
    """A file of an archive; `ZipInfo` dates all of them 1980, so equal scenes give equal bytes."""
    return ZipInfo(f"{FOLDER}/{name}")


def _scene(nodes: list[Element]) -> bytes:
    """A .mrml file."""
    root = Element("MRML", version=SCENE_VERSION, userTags="")
    root.extend(nodes)
    indent(root)
    return tostring(root, encoding="UTF-8", xml_declaration=True)


def _node(tag: str, number: int | str, name: str, attributes: Mapping[str, str], **references: Element) -> Element:
    """A node of a scene.

    Args:
        tag: its class `vtkMRML...Node` without prefix and suffix.
        number: among the nodes of its class; text: the tag of a node that replaces the one of that class and tag.
        references: other nodes, by role.
    """
    special = {"singletonTag": number} if isinstance(number, str) else {}
    if references:
        special["references"] = "".join(f"{role}:{other.get('id')};" for role, other in references.items())
    return Element(tag, {"id": f"vtkMRML{tag}Node{number}", "name": name, **attributes, **special})


def _stored(played: Played, number: int, file: str, **references: Element) -> list[Element]:
    """A node whose data is in `file`, relative to the scene's own, in LPS axes, after the node for its storage."""
    storage = _node(played.storage, number, "storage", {"fileName": file, "coordinateSystem": "LPS"})
    return [storage, _node(played.tag, number, played.name, {}, storage=storage, **references)]


FORMAT = ExportFormat(
    (".mrb",), ("times", "split", "points", *SURFACE_OPTIONS), write=write, holds="a sequence of meshes"
)
