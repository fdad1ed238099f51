"""Videos and folders of pictures for `prepare`."""

from __future__ import annotations

import json
import os
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from corpus_case import Build, Case, Step, given
from corpus_damage import NOISE, SOUND, empty_folder, link, mov_bomb, picture, pipe, png_bomb, put

PLAIN = "--border keep --masks none --depth none --poses still"
"""Options that leave the video alone."""
CONCAT, ONE = "concat:clip.mkv", "clip/1.png"
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
    return given(f"prepare {name} out {PLAIN}", put(name, content), needs="video")


def film(name: str, sizes: list[tuple[int, int]], codec: str = "ffv1", pix_fmt: str = "bgr0") -> Step:
    def encode(folder: Path) -> None:
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

    return encode


def encoded(sizes: list[tuple[int, int]]) -> Build:
    return given(f"prepare clip.mkv out {PLAIN}", film("clip.mkv", sizes))


def growing(folder: Path) -> None:
    """A stream whose pictures change their size: two films in a row."""
    for name, size in (("a.mpg", (64, 48)), ("b.mpg", (96, 80))):
        film(name, [size] * 5, "mpeg2video", "yuv420p")(folder)
    (folder / "clip.mpg").write_bytes((folder / "a.mpg").read_bytes() + (folder / "b.mpg").read_bytes())


def sound_only(folder: Path) -> None:
    with av.open(str(folder / "clip.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 44100), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def cut_video(suffix: str) -> Build:
    name, codec = f"clip{suffix}", ("ffv1", "bgr0") if suffix == ".mkv" else ("mpeg2video", "yuv420p")

    def cut(folder: Path) -> None:
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) * 2 // 3])

    return given(f"prepare {name} out {PLAIN}", film(name, [(96, 80)] * 10, *codec), cut)


def pictures_folder(*steps: Step, out: str = "out") -> Build:
    pictures = (picture(f"clip/{i}.png", NOISE) for i in range(3))
    return given(f"prepare clip {out} {PLAIN}", *pictures, *steps)


def named(name: str) -> Build:
    return given(["prepare", name, "out", *PLAIN.split()], lambda f: (f / "clip.mkv").rename(f / name), needs="video")


def second_eye(sizes: list[tuple[int, int]], options: str = "") -> Build:
    """A sound video with a right one of these sizes and a calibration."""
    command = f"prepare clip.mkv out --right right.mkv {options} {PLAIN}"
    return given(command, put("c.json", json.dumps(EYES)), film("right.mkv", sizes), needs="video")


CASES = [
    Case("no video", given("prepare clip.mp4 out"), ("clip.mp4", "no such file")),
    Case("an empty video", video("clip.mp4", b""), ("clip.mp4", "an empty file")),
    Case("a text called .mp4", video("clip.mp4", "hello\n" * 100), ("clip.mp4", "a video file")),
    Case("noise called .mp4", video("clip.mp4", np.random.default_rng(1).bytes(5000)), ("clip.mp4",)),
    Case("a picture called .mp4", video("clip.mp4", SOUND), ("clip.mp4", "a video")),
    Case("a Matroska file cut short", cut_video(".mkv"), ("clip.mkv", "Copy it again")),
    Case("an MP4 file cut short", cut_video(".mp4"), ("clip.mp4", "a video file")),
    Case("sound without pictures", given("prepare clip.mp4 out", sound_only), ("clip.mp4", "without images")),
    Case("a video of no pictures", encoded([]), ("clip.mkv",)),
    Case("a video of one picture", encoded([(64, 48)]), ("clip.mkv", "at least 2")),
    Case("a video of 1x1 px", encoded([(1, 1)] * 3), ("32",)),
    Case("a video of 2x2 px", encoded([(2, 2)] * 3), ("32",)),
    Case("a video of odd size", encoded([(65, 47)] * 3), leaves=("out",)),
    Case(
        "a video with colons in its name",
        given(f"prepare 10:30.mkv 10:30 {PLAIN}", lambda f: (f / "clip.mkv").rename(f / "10:30.mkv"), needs="video"),
        leaves=("10:30",),
    ),
    Case("a size that changes", given(f"prepare clip.mpg out {PLAIN}", growing), ("clip.mpg", "64x48", "96x80")),
    Case("a video of bombs", video("clip.mov", mov_bomb(png_bomb(16000, 15000))), ("clip.mov", "64 Mpx")),
    Case("a playlist to a local file", video("clip.mp4", HLS.format("clip.mkv")), ("clip.mp4", "a video file")),
    Case("a playlist to an address", video("clip.mp4", HLS.format("http://127.0.0.1:9/a.ts")), ("clip.mp4",)),
    Case("a playlist to a secret", video("clip.m3u8", HLS.format("file:///etc/passwd")), ("clip.m3u8", "playlist")),
    Case("a list of films", video("clip.mp4", "ffconcat version 1.0\nfile clip.mkv\n"), ("clip.mp4", "playlist")),
    Case("an address for a video", given("prepare http://127.0.0.1:9/a.mp4 out"), ("no such file",)),
    Case("a protocol for a video", given(f"prepare {CONCAT} out", needs="video"), (CONCAT, "no such file")),
    Case("a colon in the name", named("http:a.mkv"), leaves=("out",)),
    Case("many alphabets in the name", named("é ☃\n%03d.mkv"), leaves=("out",)),
    Case("a video whose name is no text", named(os.fsdecode(b"\xff.mkv")), leaves=("out",)),
    Case("a pipe for a video", given("prepare clip.mp4 out", pipe("clip.mp4")), ("clip.mp4", "pipe")),
    Case("an endless device for a video", given("prepare a.mp4 out", link("a.mp4", "/dev/zero")), ("a.mp4", "device")),
    Case("a folder without pictures", given("prepare clip out", empty_folder("clip")), ("clip", "none")),
    Case("a picture of the folder is a bomb", pictures_folder(put(ONE, png_bomb())), (ONE, "60000x60000")),
    Case("a picture of another size", pictures_folder(picture(ONE, NOISE[:30])), (ONE, "48x40", "48x30")),
    Case("a picture of the folder is text", pictures_folder(put("clip/1.png", "x")), ("clip/1.png",)),
    Case("a second eye of another size", second_eye([(64, 48)] * 3), ("right.mkv", "96x80", "64x48")),
    Case(
        "a second eye that ends",
        second_eye([(96, 80)] * 3, "--calibration c.json"),
        leaves=("out",),
        check=lambda work: len(list((work / "out/images").iterdir())) == 3,
    ),
]
