"""Meshes with values at their vertices for VTK and ParaView: `.vtp` for one time, `.pvd` for the times together.

Source: VTK's documentation of its XML file formats. An array is the Base64 of its length in bytes, 64 bits, and itself.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

KINDS = {"<f4": "Float32", "<i4": "Int32"}
"""Names of the types of arrays."""
HEAD = '<?xml version="1.0"?>\n<VTKFile type="{}" version="1.0" byte_order="LittleEndian" header_type="UInt64">'


def vtp_bytes(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], values: Mapping[str, NDArray], about: str
) -> bytes:
    """A surface as VTK's PolyData.

    Args:
        vertices: (V, 3), in the axes of the file. triangles: (F, 3) vertex numbers.
        values: (V,) each, by the name under which programs list them; the first is shown. NaN where unknown.
        about: a comment on axes and unit.
    """
    ends = 3 * np.arange(1, len(triangles) + 1, dtype="<i4")
    lines = [
        HEAD.format("PolyData"),
        f"<!-- {about} -->",
        f'<PolyData><Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{len(triangles)}">',
        f'<PointData Scalars="{next(iter(values))}">',
        *(_array(name, column.astype("<f4")) for name, column in values.items()),
        "</PointData>",
        f"<Points>{_array('Points', vertices.astype('<f4'))}</Points>",
        f"<Polys>{_array('connectivity', triangles.astype('<i4').ravel())}{_array('offsets', ends)}</Polys>",
        "</Piece></PolyData>\n</VTKFile>\n",
    ]
    return "\n".join(lines).encode()


def pvd_bytes(files: Sequence[str], seconds: Sequence[float]) -> bytes:
    """The list of the files of a series, relative to it, and the time of each, s."""
    sets = [
        f'<DataSet timestep="{time:.9g}" part="0" file="{file}"/>' for file, time in zip(files, seconds, strict=True)
    ]
    return "\n".join([HEAD.format("Collection"), "<Collection>", *sets, "</Collection>\n</VTKFile>\n"]).encode()


def _array(name: str, array: NDArray) -> str:
    """One array, of rows of 1 or 3 numbers."""
    body = base64.b64encode(np.uint64(array.nbytes).tobytes() + array.tobytes()).decode()
    rows = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
    return f'<DataArray type="{KINDS[array.dtype.str]}" Name="{name}"{rows} format="binary">{body}</DataArray>'
