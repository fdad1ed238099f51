"""Files of scenes and checkpoints taken apart, changed and put together again, by the file format's own rules."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

NUMPY = {"F32": "<f4", "F64": "<f8", "I64": "<i8", "U8": "u1"}


@dataclass
class StateFile:
    """A safetensors file in memory."""

    about: dict[str, Any]
    """The description, in the metadata."""
    arrays: dict[str, np.ndarray]

    @staticmethod
    def read(path: Path) -> StateFile:
        """Every array and the description, without the digest, which would reject every change."""
        raw = path.read_bytes()
        end = 8 + int.from_bytes(raw[:8], "little")
        header = json.loads(raw[8:end])
        about = json.loads(header.pop("__metadata__")["endoprior"])
        about.pop("digest", None)
        arrays = {}
        for name, entry in header.items():
            first, last = entry["data_offsets"]
            values = np.frombuffer(raw[end + first : end + last], NUMPY[entry["dtype"]])
            arrays[name] = values.reshape(entry["shape"]).copy()
        return StateFile(about, arrays)

    def header(self) -> dict[str, Any]:
        """What stands before the arrays."""
        names = {np.dtype(code): name for name, code in NUMPY.items()} | {np.dtype("f2"): "F16", np.dtype("i4"): "I32"}
        header: dict[str, Any] = {"__metadata__": {"endoprior": json.dumps(self.about)}}
        start = 0
        for name, values in self.arrays.items():
            stop = start + values.nbytes
            shape = list(values.shape)
            header[name] = {"dtype": names[values.dtype], "shape": shape, "data_offsets": [start, stop]}
            start = stop
        return header

    def data(self) -> bytes:
        """The arrays, one after the other."""
        return b"".join(values.tobytes() for values in self.arrays.values())

    def write(self, path: Path, change_header: Callable[[dict[str, Any]], Any] = lambda header: None) -> None:
        """Put it together again, with a header that was changed in place."""
        header = self.header()
        change_header(header)
        path.write_bytes(packed(json.dumps(header).encode(), self.data()))


def packed(header: bytes, data: bytes, length: int | None = None) -> bytes:
    """The bytes of a file whose header says that it is `length` long."""
    return (len(header) if length is None else length).to_bytes(8, "little") + header + data
