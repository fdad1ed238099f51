"""Videos and folders of pictures for `prepare`."""

from __future__ import annotations

import json
import os
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from corpus_case import Build, Case, Samples
from corpus_damage import (
    NOISE,
    SOUND,
    picture,
    png_bomb,
    put,
)

PLAIN = ["--border", "keep", "--masks", "none", "--depth", "none", "--poses", "still"]
"""Options that leave the video alone."""
HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{}\n#EXT-X-ENDLIST\n"
EYES = {
    "K_left": [[90, 0, 48], [0, 90, 40], [0, 0, 1]],
    "K_right": [[90, 0, 48], [0, 90, 40], [0, 0, 1]],
    "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "T_mm": [-4, 0, 0],
    "width": 96,
    "height": 80,
}


def video(name: str, content: bytes | str) -> Build:
    """A file of these bytes in place of a video, in a folder with a sound one."""

    def build(folder: Path, samples: Samples) -> list[str]:
        samples.copy("video", folder / "sound.mkv")
        put(name, content)(folder)
        return ["prepare", name, "out", *PLAIN]

    return build


def encoded(name: str, sizes: list[tuple[int, int]], codec: str = "ffv1", pix_fmt: str = "bgr0") -> Build:
    """A video of one picture for each (width, height)."""

    def build(folder: Path, samples: Samples) -> list[str]:
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=25)
            stream.width, stream.height = sizes[0] if sizes else (64, 48)
            stream.pix_fmt = pix_fmt
            for index, (width, height) in enumerate(sizes):
                texture = cv2.resize(NOISE, (width, height), interpolation=cv2.INTER_NEAREST)
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(texture), format="rgb24")
                frame.pts, frame.time_base = index, Fraction(1, 25)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return ["prepare", name, "out", *PLAIN]

    return build


def growing(folder: Path, samples: Samples) -> list[str]:
    """A stream whose pictures change their size: two films in a row."""
    for name, size in (("a.mpg", (64, 48)), ("b.mpg", (96, 80))):
        encoded(name, [size] * 5, "mpeg2video", "yuv420p")(folder, samples)
    (folder / "clip.mpg").write_bytes((folder / "a.mpg").read_bytes() + (folder / "b.mpg").read_bytes())
    return ["prepare", "clip.mpg", "out", *PLAIN]


def sound_only(folder: Path, samples: Samples) -> list[str]:
    """A film without pictures."""
    with av.open(str(folder / "clip.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 44100), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return ["prepare", "clip.mp4", "out", *PLAIN]


def cut_video(suffix: str) -> Build:
    """A film whose last third is missing."""

    def build(folder: Path, samples: Samples) -> list[str]:
        name = f"clip{suffix}"
        codec = ("ffv1", "bgr0") if suffix == ".mkv" else ("mpeg2video", "yuv420p")
        encoded(name, [(96, 80)] * 10, *codec)(folder, samples)
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) * 2 // 3])
        return ["prepare", name, "out", *PLAIN]

    return build


def pictures_folder(*damages: object) -> Build:
    """A folder of pictures in place of a video, damaged."""

    def build(folder: Path, samples: Samples) -> list[str]:
        for i in range(3):
            picture(f"clip/{i}.png", NOISE)(folder)
        for damage in damages:
            damage(folder)
        return ["prepare", "clip", "out", *PLAIN]

    return build


CASES = [
    Case("no video", lambda f, s: ["prepare", "clip.mp4", "out"], ("clip.mp4", "no such file")),
    Case("an empty video", video("clip.mp4", b""), ("clip.mp4", "an empty file")),
    Case("a text called .mp4", video("clip.mp4", "hello\n" * 100), ("clip.mp4", "a video file")),
    Case("noise called .mp4", video("clip.mp4", np.random.default_rng(1).bytes(5000)), ("clip.mp4",)),
    Case("a picture called .mp4", video("clip.mp4", SOUND), ("clip.mp4", "a video")),
    Case("a Matroska file cut short", cut_video(".mkv"), ("clip.mkv", "Copy it again")),
    Case("an MP4 file cut short", cut_video(".mp4"), ("clip.mp4", "a video file")),
    Case("sound without pictures", sound_only, ("clip.mp4", "without pictures")),
    Case("a video of no pictures", encoded("clip.mkv", []), ("clip.mkv",)),
    Case("a video of one picture", encoded("clip.mkv", [(64, 48)]), ("clip.mkv", "at least 2")),
    Case("a video of 1x1 px", encoded("clip.mkv", [(1, 1)] * 3), ("32",)),
    Case("a video of 2x2 px", encoded("clip.mkv", [(2, 2)] * 3), ("32",)),
    Case("a video of odd size", encoded("clip.mkv", [(65, 47)] * 3), leaves=("out",)),
    Case("a size that changes", growing, ("clip.mpg", "64x48", "96x80")),
    Case("a playlist to a local file", video("clip.mp4", HLS.format("sound.mkv")), ("clip.mp4", "a video file")),
    Case("a playlist to an address", video("clip.mp4", HLS.format("http://127.0.0.1:9/a.ts")), ("clip.mp4",)),
    Case("a playlist to a secret", video("clip.m3u8", HLS.format("file:///etc/passwd")), ("clip.m3u8", "playlist")),
    Case("a list of films", video("clip.mp4", "ffconcat version 1.0\nfile sound.mkv\n"), ("clip.mp4", "playlist")),
    Case("an address for a video", lambda f, s: ["prepare", "http://127.0.0.1:9/a.mp4", "out"], ("no such file",)),
    Case(
        "a protocol for a video",
        lambda f, s: ["prepare", f"concat:{s.copy('video', f / 'a.mkv').name}", "out"],
        ("concat:a.mkv", "no such file"),
    ),
    Case(
        "a colon in the name",
        lambda f, s: ["prepare", s.copy("video", f / "http:a.mkv").name, "out", *PLAIN],
        leaves=("out",),
    ),
    Case(
        "many alphabets in the name",
        lambda f, s: ["prepare", s.copy("video", f / "é ☃\n%03d.mkv").name, "out", *PLAIN],
        leaves=("out",),
    ),
    Case(
        "a video whose name is no text",
        lambda f, s: ["prepare", s.copy("video", f / os.fsdecode(b"\xff.mkv")).name, "out", *PLAIN],
        leaves=("out",),
    ),
    Case(
        "a pipe for a video",
        lambda f, s: [os.mkfifo(f / "clip.mp4"), ["prepare", "clip.mp4", "out"]][1],
        ("clip.mp4", "pipe"),
    ),
    Case(
        "an endless device for a video",
        lambda f, s: [(f / "clip.mp4").symlink_to("/dev/zero"), ["prepare", "clip.mp4", "out"]][1],
        ("clip.mp4", "device"),
    ),
    Case(
        "a folder without pictures",
        lambda f, s: [(f / "clip").mkdir(), ["prepare", "clip", "out"]][1],
        ("clip", "none"),
    ),
    Case(
        "a picture of the folder is a bomb",
        pictures_folder(put("clip/1.png", png_bomb())),
        ("clip/1.png", "60000x60000"),
    ),
    Case(
        "a picture of the folder has another size",
        pictures_folder(picture("clip/1.png", NOISE[:30])),
        ("clip/1.png", "48x40", "48x30"),
    ),
    Case("a picture of the folder is text", pictures_folder(put("clip/1.png", "x")), ("clip/1.png",)),
    Case(
        "a second eye of another size",
        lambda f, s: [
            s.copy("video", f / "clip.mkv"),
            encoded("right.mkv", [(64, 48)] * 3)(f, s),
            ["prepare", "clip.mkv", "out", "--right", "right.mkv", *PLAIN],
        ][2],
        ("right.mkv", "96x80", "64x48"),
    ),
    Case(
        "a second eye that ends",
        lambda f, s: [
            s.copy("video", f / "clip.mkv"),
            put("c.json", json.dumps(EYES))(f),
            encoded("right.mkv", [(96, 80)] * 3)(f, s),
            ["prepare", "clip.mkv", "out", "--right", "right.mkv", "--calibration", "c.json", *PLAIN],
        ][3],
        ("right.mkv", "picture 3"),
    ),
]
