"""Triangle meshes as PLY, Wavefront OBJ and binary STL.

Sources: Turk, "The PLY Polygon File Format", 1994; Wavefront, "Object Files (.obj)", with colors after the coordinates
as is customary; 3D Systems, "StereoLithography Interface Specification", 1989.
"""

from __future__ import annotations

import io
import struct

import numpy as np
from numpy.typing import NDArray

from .formats import Axes
from .ply import ply_bytes, vertex_table


def encode_mesh(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    colors: NDArray[np.uint8],
    suffix: str,
    axes: Axes,
    unit: str = "mm",
) -> bytes:
    """A mesh as the bytes of a file.

    Args:
        vertices: (V, 3) mm, in `axes`. triangles: (F, 3) vertex numbers. colors: (V, 3), 0..255.
        suffix: ply, obj or stl.
        unit: of lengths, named in the file.
    """
    if suffix == "ply":
        columns = {name: vertices[:, i] for i, name in enumerate("xyz")}
        columns |= {name: colors[:, i] for i, name in enumerate(("red", "green", "blue"))}
        return ply_bytes(vertex_table(columns), axes, unit, triangles)
    about = _about(axes, unit)
    return _obj(vertices, triangles, colors, about) if suffix == "obj" else _stl(vertices, triangles, about)


def _about(axes: Axes, unit: str) -> str:
    """Header text; `SPACE=LPS` or `SPACE=RAS` is what 3D Slicer looks for."""
    return f"endoprior, axes {axes}, unit {unit}" + (f", SPACE={axes.upper()}" if axes in ("lps", "ras") else "")


def _obj(vertices: NDArray, triangles: NDArray, colors: NDArray, about: str) -> bytes:
    text = io.StringIO()
    text.write(f"# {about}\n")
    np.savetxt(text, np.column_stack([vertices, colors / 255]), "v %.6g %.6g %.6g %.4f %.4f %.4f")
    np.savetxt(text, triangles + 1, "f %d %d %d")
    return text.getvalue().encode()


def _stl(vertices: NDArray, triangles: NDArray, about: str) -> bytes:
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["normal"], facets["corners"] = normals / np.where(length > 0, length, 1), corners
    # The header must not begin with "solid": readers would take the file for STL in text form.
    return about.encode().ljust(80) + struct.pack("<I", len(triangles)) + facets.tobytes()
