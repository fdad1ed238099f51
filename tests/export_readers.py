"""Readers of splat containers that share nothing with the package's writers."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from pygltflib import GLTF2


def read_splat(data: bytes) -> dict[str, np.ndarray]:
    """Decode .splat: 3 floats center, 3 floats scale, 4 bytes color, 4 bytes rotation."""
    rows = [struct.unpack("<3f3f4B4B", data[i : i + 32]) for i in range(0, len(data), 32)]
    table = np.array(rows)
    return {"centers": table[:, :3], "scales": table[:, 3:6], "rgba": table[:, 6:10], "quats": table[:, 10:] / 128 - 1}


def read_spz(data: bytes) -> dict[str, np.ndarray]:
    """Decode SPZ version 2 from its specification."""
    plain = gzip.decompress(data)
    magic, version, num, degree, fractional_bits, flags, reserved = struct.unpack_from("<IIIBBBB", plain)
    assert (magic, version, flags, reserved) == (0x5053474E, 2, 0, 0)
    num_rest = (degree + 1) ** 2 - 1
    blocks, at = [], 16
    for width in (9, 1, 3, 3, 3, 3 * num_rest):
        blocks.append(np.frombuffer(plain, np.uint8, num * width, at).reshape(num, width).astype(np.int64))
        at += num * width
    assert at == len(plain)
    positions, alphas, colors, scales, rotations, rest = blocks
    positions = positions.reshape(num, 3, 3) @ [1, 1 << 8, 1 << 16]
    positions = np.where(positions >= 1 << 23, positions - (1 << 24), positions)
    xyz = rotations / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))
    return {
        "means": positions / 2.0**fractional_bits,
        "opacities": alphas[:, 0] / 255,
        "dc": (colors / 255 - 0.5) / 0.15,
        "scales": np.exp(scales / 16 - 10),
        "quats": np.concatenate([w, xyz], 1),
        "rest": (rest.reshape(num, num_rest, 3) - 128) / 128,
        "bits": fractional_bits,
    }


def read_glb(data: bytes, folder: Path) -> tuple[GLTF2, dict[str, np.ndarray]]:
    """The document and the arrays of its only primitive."""
    file = folder / "a.glb"
    file.write_bytes(data)
    gltf = GLTF2().load(str(file))
    blob = gltf.binary_blob()
    (primitive,) = gltf.meshes[0].primitives
    arrays = {}
    for name, index in vars(primitive.attributes).items():
        if index is None:
            continue
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        assert accessor.componentType == 5126 and view.byteOffset % 4 == 0
        arrays[name] = np.frombuffer(blob, "<f4", accessor.count * width, view.byteOffset).reshape(-1, width)
    return gltf, arrays
