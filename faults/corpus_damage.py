"""Ways to make and to damage files, which lists of cases are put together from; files that unfold to gigabytes."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from corpus_case import Build, Step, given

CHECK = "check data"


def damaged(*steps: Step, command: str = CHECK) -> Build:
    """A sound sequence in `data`, damaged by steps in that folder."""
    return given(command, *(inside("data", step) for step in steps), needs="sequence")


def made(*steps: Step, command: str = CHECK) -> Build:
    """A folder `data` that steps fill from nothing."""
    return given(command, empty_folder("data"), *(inside("data", step) for step in steps))


def inside(name: str, step: Step) -> Step:
    return lambda folder: step(folder / name)


def empty_folder(name: str) -> Step:
    return lambda folder: (folder / name).mkdir()


def without(name: str) -> Step:
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


def put(name: str, content: bytes | str) -> Step:
    data = content.encode() if isinstance(content, str) else content

    def damage(data_folder: Path) -> None:
        path = data_folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(data)

    return damage


def picture(name: str, pixels: np.ndarray, suffix: str = "") -> Step:
    """Replaces a file by an encoded picture, of another kind than its name says if `suffix` is given."""
    return put(name, cv2.imencode(suffix or Path(name).suffix, pixels)[1].tobytes())


def everywhere(part: str, pixels: np.ndarray) -> Step:
    """Replaces all pictures of one folder."""
    return lambda data: [picture(f"{part}/{file.name}", pixels)(data) for file in (data / part).iterdir()]


def described(**changes: object) -> Step:
    def damage(data: Path) -> None:
        path = data / "sequence.json"
        stored = json.loads(path.read_text(encoding="utf-8")) | changes
        path.write_text(json.dumps({k: v for k, v in stored.items() if v is not None}), encoding="utf-8")

    return damage


def poses(change: Callable[[np.ndarray], object]) -> Step:
    """Changes `poses_bounds.npy`, in place or to what is returned."""

    def damage(data: Path) -> None:
        stored = np.load(data / "poses_bounds.npy")
        result = change(stored)
        np.save(data / "poses_bounds.npy", stored if result is None else result)

    return damage


def entry(row: int, column: int, value: float) -> Step:
    return poses(lambda p: p.__setitem__((row, column), value))


def link(name: str, target: str) -> Step:
    return lambda data: ((data / name).unlink(missing_ok=True), (data / name).symlink_to(target))


def pipe(name: str) -> Step:
    return lambda data: ((data / name).unlink(missing_ok=True), os.mkfifo(data / name))


def instead(name: str) -> Step:
    """A folder in place of a file, or a file in place of a folder."""

    def damage(data: Path) -> None:
        path = data / name
        if path.is_dir():
            shutil.rmtree(path)
            path.write_text("a file", encoding="utf-8")
        else:
            path.unlink(missing_ok=True)
            path.mkdir()

    return damage


def closed(name: str) -> Step:
    return lambda data: (data / name).chmod(0)


def first_frames(count: int) -> Step:
    def damage(data: Path) -> None:
        for part in ("images", "masks", "depth"):
            for file in sorted((data / part).iterdir())[count:]:
                file.unlink()
        poses(lambda p: p[:count])(data)

    return damage


def sized(width: int, height: int, plain: bool = False) -> Step:
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
    written = io.BytesIO()
    np.save(written, array)
    return written.getvalue()


def lying_npy(shape: str = "(1000000000, 1000000)", descr: str = "'<f8'") -> bytes:
    return npy(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}", bytes(64))


def npz_bomb(names: tuple[str, ...] = ("a",)) -> bytes:
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
HALF_EXR = b"v/1\x01\x02\0\0\0channels\0"
NESTED = "[" * 100_000
IMAGE = "images/000003.png"
DRAWS = ("data_check.png",)
FRAME_MARKER = b"\xff\xc2\0\x0b\x08"
"""Start of the segment of a gray progressive JPEG that holds height and width."""


def jpeg_bomb(width: int = 65500, height: int = 65500) -> bytes:
    """A tiny progressive JPEG of this size."""
    sound = cv2.imencode(".jpg", NOISE[..., 0], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    at = sound.index(FRAME_MARKER) + len(FRAME_MARKER)
    return sound[:at] + struct.pack(">HH", height, width) + sound[at + 4 :]


def jpeg_of_two_sizes() -> bytes:
    """A JPEG of 16000x16000 px that says 16x16 to readers for which every marker has a length.

    The marker 01 has none. Who reads one jumps over the next segment, into a comment that holds another start.
    """
    bomb, first = jpeg_bomb(16000, 16000), 60000
    comment = b"\xff\xfe" + struct.pack(">H", first) + bytes(first - 2)
    gap = 4 + 0xFFFE - (2 + 2 + len(comment))
    start = b"\xff\xc0\0\x0b\x08\0\x10\0\x10\1\1\x11\0\xff\xd9"
    other = bytes(gap - 4) + start + bytes(100)
    return bomb[:2] + b"\xff\x01" + comment + b"\xff\xfe" + struct.pack(">H", len(other) + 2) + other + bomb[2:]


def tiff_bomb(*sizes: tuple[int, int]) -> bytes:
    """A gray TIFF that states each of these sizes; its strips of 100 rows are the same few bytes."""
    width, height = max(sizes)
    strip, count = zlib.compress(bytes(100 * width), 9), height // 100
    tags = [(tag, 4, 1, struct.pack("<I", side)) for size in sizes for tag, side in zip((256, 257), size, strict=True)]
    tags += [(tag, 3, 1, struct.pack("<HH", value, 0)) for tag, value in ((258, 8), (259, 8), (262, 1), (277, 1))]
    tags += [(278, 4, 1, struct.pack("<I", 100))]
    at = 8 + 2 + 12 * (len(tags) + 2) + 4
    body = strip
    for tag, value in ((273, at), (279, len(strip))):
        tags.append((tag, 4, count, struct.pack("<I", at + len(body))))
        body += struct.pack("<I", value) * count
    directory = b"".join(struct.pack("<HHI", *tag[:3]) + tag[3] for tag in sorted(tags, key=lambda tag: tag[0]))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + directory + bytes(4) + body


def mov_bomb(picture: bytes, codec: str = "png") -> bytes:
    """A QuickTime video of 64x48 px whose images are this larger one. FFmpeg decodes one when it opens the file."""
    written = io.BytesIO()
    with av.open(written, "w", format="mov") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "rgb24" if codec == "png" else "yuvj420p"
        stream.codec_context.time_base = Fraction(1, 25)
        for index in range(3):
            packet = av.Packet(picture)
            packet.stream, packet.pts, packet.dts, packet.is_keyframe = stream, index, index, True
            packet.time_base = Fraction(1, 25)
            container.mux(packet)
    return written.getvalue()
