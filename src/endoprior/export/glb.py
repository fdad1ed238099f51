"""Binary glTF 2.0 files: the arrays of their buffer, and the container. Source: the glTF 2.0 specification."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

MM_TO_METERS = [0.001] * 3
"""Scale of a node whose data is in mm; glTF counts meters."""
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
_COMPONENTS = {"<f4": 5126, "<u4": 5125}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class Buffer:
    """The arrays of a file, one after the other; others refer to them by the number of their accessor."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, int]] = []
        self._contents: list[bytes] = []
        self._size = 0

    def add(self, values: NDArray, target: int | None = None, *, bounds: bool = False) -> int:
        """Append float32 or uint32 `values`, (count,) or (count, 3 or 4), and return the number of their accessor.

        Args:
            target: VERTEX_BUFFER or INDEX_BUFFER; None for what is neither.
            bounds: also store minimum and maximum, as positions and times of keyframes must.
        """
        columns = values.reshape(len(values), -1)
        accessor = {"bufferView": len(self._views), "componentType": _COMPONENTS[values.dtype.str]}
        accessor |= {"count": len(columns), "type": _KINDS[columns.shape[1]]}
        if bounds:
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": values.nbytes}
        self._views.append(view | ({} if target is None else {"target": target}))
        self.accessors.append(accessor)
        self._contents.append(values.tobytes())
        self._size += values.nbytes
        return len(self.accessors) - 1

    def file(self, document: dict[str, Any], extras: dict[str, Any]) -> bytes:
        """The bytes of a .glb file.

        Args:
            document: the JSON document without `asset`, `accessors`, `bufferViews` and `buffers`.
            extras: `extras` of its `asset`.
        """
        document = {
            "asset": {"version": "2.0", "generator": "endoprior", "extras": extras},
            **document,
            "accessors": self.accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        return _container(document, b"".join(self._contents))


def decoded_srgb(encoded: NDArray) -> NDArray:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """Header, a JSON chunk padded with spaces, a binary chunk padded with zeros, both to 4 bytes."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    chunks = b""
    for kind, content, filler in ((b"JSON", text, b" "), (b"BIN\0", binary, b"\0")):
        content += filler * (-len(content) % 4)
        chunks += struct.pack("<I4s", len(content), kind) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
