"""Ways to make and to damage files, which the lists of cases are put together from."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from corpus_case import Build, Samples

CHECK = ["check", "data"]
Damage = Callable[[Path], object]


def damaged(damage: Damage, command: list[str] = CHECK) -> Build:
    """A sound sequence in `data`, damaged."""

    def build(folder: Path, samples: Samples) -> list[str]:
        damage(samples.copy("sequence", folder / "data"))
        return command

    return build


def made(write: Damage, command: list[str] = CHECK) -> Build:
    """A folder `data` that `write` fills from nothing."""

    def build(folder: Path, samples: Samples) -> list[str]:
        (folder / "data").mkdir()
        write(folder / "data")
        return command

    return build


def put(name: str, content: bytes | str) -> Damage:
    """Replaces a file by these bytes."""
    data = content.encode() if isinstance(content, str) else content

    def damage(data_folder: Path) -> None:
        path = data_folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(data)

    return damage


def picture(name: str, pixels: np.ndarray, suffix: str = "") -> Damage:
    """Replaces a file by an encoded picture, of another kind than its name says if `suffix` is given."""
    return put(name, cv2.imencode(suffix or Path(name).suffix, pixels)[1].tobytes())


def everywhere(part: str, pixels: np.ndarray) -> Damage:
    """Replaces all pictures of one folder."""
    return lambda data: [picture(f"{part}/{file.name}", pixels)(data) for file in (data / part).iterdir()]


def described(**changes: object) -> Damage:
    """Changes keys of sequence.json, None removes one; NaN is written as such."""

    def damage(data: Path) -> None:
        path = data / "sequence.json"
        stored = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({k: v for k, v in stored.items() if v is not None}))

    return damage


def poses(change: Callable[[np.ndarray], object]) -> Damage:
    """Changes `poses_bounds.npy`, in place or to what is returned."""

    def damage(data: Path) -> None:
        stored = np.load(data / "poses_bounds.npy")
        result = change(stored)
        np.save(data / "poses_bounds.npy", stored if result is None else result)

    return damage


def entry(row: int, column: int, value: float) -> Damage:
    """One number of the poses."""
    return poses(lambda p: p.__setitem__((row, column), value))


def link(name: str, target: str) -> Damage:
    """A link in place of a file."""
    return lambda data: ((data / name).unlink(missing_ok=True), (data / name).symlink_to(target))


def pipe(name: str) -> Damage:
    """A named pipe in place of a file: opening it waits for ever."""
    return lambda data: ((data / name).unlink(missing_ok=True), os.mkfifo(data / name))


def instead(name: str) -> Damage:
    """A folder in place of a file, or a file in place of a folder."""

    def damage(data: Path) -> None:
        path = data / name
        if path.is_dir():
            shutil.rmtree(path)
            path.write_text("a file")
        else:
            path.unlink(missing_ok=True)
            path.mkdir()

    return damage


def closed(name: str) -> Damage:
    """Takes all rights away."""
    return lambda data: (data / name).chmod(0)


def first_frames(count: int) -> Damage:
    """Leaves so many frames."""

    def damage(data: Path) -> None:
        for part in ("images", "masks", "depth"):
            for file in sorted((data / part).iterdir())[count:]:
                file.unlink()
        poses(lambda p: p[:count])(data)

    return damage


def sized(width: int, height: int, plain: bool = False) -> Damage:
    """A whole sequence of another size, from nothing; as a plain folder, depth is in .npy files."""

    def write(data: Path) -> None:
        rng = np.random.default_rng(0)
        for part, pixels in (
            ("images", rng.integers(60, 200, (height, width, 3), dtype=np.uint8)),
            ("masks", np.zeros((height, width), np.uint8)),
            ("depth", np.full((height, width), 60, np.uint16)),
        ):
            for i in range(3):
                if plain and part == "depth":
                    put(f"{part}/{i}.npy", whole_npy(pixels.astype(np.float32)))(data)
                else:
                    picture(f"{part}/{i}.png", pixels)(data)
        if not plain:
            row = np.column_stack([np.eye(3), np.zeros(3), (height, width, width)]).ravel()
            np.save(data / "poses_bounds.npy", np.tile(np.append(row, (40, 80)), (3, 1)))

    return write


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """One chunk of a PNG file with its checksum."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_bomb(width: int = 60000, height: int = 60000) -> bytes:
    """A tiny PNG file whose header promises gigabytes; its checksums hold."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(100_000), 9)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", body) + png_chunk(b"IEND", b"")


def npy(header: str, body: bytes = b"") -> bytes:
    """An .npy file with this header, whatever it claims."""
    text = (header + "\n").encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def whole_npy(array: np.ndarray) -> bytes:
    """A sound .npy file."""
    written = io.BytesIO()
    np.save(written, array)
    return written.getvalue()


def lying_npy(shape: str = "(1000000000, 1000000)", descr: str = "'<f8'") -> bytes:
    """An .npy file that promises terabytes."""
    return npy(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}", bytes(64))


def npz_bomb(names: tuple[str, ...] = ("a",)) -> bytes:
    """A small .npz file that unfolds to 2 GB."""
    packed, block = io.BytesIO(), bytes(1 << 20)
    header = lying_npy("(2147483648,)", "'|u1'")[:-64]
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(header)
                for _ in range(2048):
                    member.write(block)
    return packed.getvalue()


def executing_pickle() -> bytes:
    """A pickle that makes the file `executed` where it is loaded without care."""
    return b"cos\nsystem\n(S'touch executed'\ntR."


def pickled_npy() -> bytes:
    """The same inside of an .npy file of objects."""
    return npy("{'descr': '|O', 'fortran_order': False, 'shape': (17, 17), }", executing_pickle())


NOISE = np.random.default_rng(0).integers(0, 255, (40, 48, 3), dtype=np.uint8)
SOUND = cv2.imencode(".png", NOISE)[1].tobytes()
FLIPPED = SOUND[:300] + bytes([SOUND[300] ^ 255]) + SOUND[301:]
HALF_JPEG = cv2.imencode(".jpg", NOISE)[1].tobytes()[:600]
NESTED = "[" * 100_000
IMAGE = "images/000003.png"
DRAWS = ("check.png",)
