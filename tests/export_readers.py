"""Readers of splat containers that share nothing with the package's writers."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image
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


def read_compressed_ply(data: bytes) -> dict[str, np.ndarray]:
    """Decode PlayCanvas' compressed PLY, in the order of the file."""
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    elements = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    num, chunks = elements["vertex"], elements["chunk"]
    assert chunks == -(-num // 256) and lines[1] == "format binary_little_endian 1.0"
    ranges = np.frombuffer(body, "<f4", chunks * 18).reshape(chunks, 18)[np.arange(num) // 256].astype(float)
    packed = np.frombuffer(body, "<u4", num * 4, chunks * 72).reshape(num, 4).astype(np.int64)
    width = sum("f_rest" in line for line in lines)
    rest = np.frombuffer(body, np.uint8, offset=chunks * 72 + num * 16).reshape(num, width)

    def three(words, at):
        shares = np.stack([(words >> 21) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047], 1)
        return ranges[:, at : at + 3] * (1 - shares) + ranges[:, at + 3 : at + 6] * shares

    quats = np.zeros((num, 4))
    for row, word in enumerate(packed[:, 1]):
        others = np.array([(word >> shift & 1023) / 1023 - 0.5 for shift in (20, 10, 0)]) * np.sqrt(2)
        kept = [i for i in range(4) if i != word >> 30]
        quats[row, kept] = others
        quats[row, word >> 30] = np.sqrt(max(0, 1 - (others**2).sum()))
    color = np.stack([packed[:, 3] >> 24, packed[:, 3] >> 16 & 255, packed[:, 3] >> 8 & 255], 1) / 255
    color = ranges[:, 12:15] * (1 - color) + ranges[:, 15:18] * color
    return {
        "means": three(packed[:, 0], 0),
        "quats": quats,
        "scales": np.exp(three(packed[:, 2], 6)),
        "dc": (color - 0.5) / 0.28209479177387814,
        "opacities": (packed[:, 3] & 255) / 255,
        "rest": (rest * (8 / 255) - 4).reshape(num, 3, width // 3).transpose(0, 2, 1),
    }


def read_sog(data: bytes) -> dict[str, np.ndarray]:
    """Decode SOG version 2 without higher harmonics, from its specification."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    about = json.loads(archive.read("meta.json"))
    num = about["count"]
    assert about["version"] == 2 and "shN" not in about

    def pixels(name: str) -> np.ndarray:
        image = Image.open(io.BytesIO(archive.read(name)))
        assert image.format == "WEBP"
        return np.array(image).reshape(-1, len(image.mode))[:num].astype(np.int64)

    low, high = (pixels(name) for name in about["means"]["files"])
    shares = (low + (high << 8)) / 65535
    least, most = np.array(about["means"]["mins"]), np.array(about["means"]["maxs"])
    logs = least + (most - least) * shares
    (scales,), (colors,), (quats,) = ([pixels(f) for f in about[name]["files"]] for name in ("scales", "sh0", "quats"))
    unit = np.zeros((num, 4))
    for row, (*others, alpha) in zip(unit, quats, strict=True):
        parts = (np.array(others) / 255 - 0.5) * np.sqrt(2)
        row[[i for i in range(4) if i != alpha - 252]] = parts
        row[alpha - 252] = np.sqrt(max(0, 1 - (parts**2).sum()))
    return {
        "means": np.sign(logs) * (np.exp(np.abs(logs)) - 1),
        "log_scales": np.array(about["scales"]["codebook"])[scales],
        "quats": unit,
        "dc": np.array(about["sh0"]["codebook"])[colors[:, :3]],
        "opacities": colors[:, 3] / 255,
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
