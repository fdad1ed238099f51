"""What `prepare` is given beside the video: calibrations, masks, depth, poses, and places to write to."""

from __future__ import annotations

import json

import cv2
import numpy as np
from corpus_case import Build, Case, Step, given
from corpus_damage import (
    NESTED,
    NOISE,
    empty_folder,
    executing_pickle,
    lying_npy,
    npz_bomb,
    pickled_npy,
    pipe,
    png_bomb,
    put,
    whole_npy,
)
from corpus_videos import EYES, PLAIN, pictures_folder


def calibrated(name: str, content: bytes | str) -> Build:
    """A sound video with this calibration."""
    return given(f"prepare clip.mkv out --calibration {name} {PLAIN}", put(name, content), needs="video")


def eyes(**changes: object) -> Build:
    """A calibration of two eyes with some entries changed; its layout is stated, for the video shows one camera."""
    return calibrated("c.json", json.dumps(EYES | {"layout": "interlaced"} | changes))


def beside(option: str, name: str, *steps: Step, more: str = "") -> Build:
    """A sound video of ten pictures with what an option names."""
    words, given_already = PLAIN.split(), (option, *more.split())
    kept = [word for pair in zip(words[::2], words[1::2], strict=True) if pair[0] not in given_already for word in pair]
    return given(["prepare", "clip.mkv", "out", option, name, *more.split(), *kept], *steps, needs="video")


def ten(folder: str, content: bytes, suffix: str, last: bytes = b"") -> Step:
    """Ten equal files, but for the last if it is given."""
    return lambda place: [put(f"{folder}/{i}{suffix}", last if last and i == 9 else content)(place) for i in range(10)]


def moving(poses: np.ndarray) -> Build:
    """A sound video with these poses."""
    return beside("--poses", "p.npy", lambda f: np.save(f / "p.npy", poses))


def preparing(out: str, *steps: Step) -> Build:
    """A sound video, to be written to `out`."""
    return given(["prepare", "clip.mkv", out, *PLAIN.split()], *steps, needs="video")


MASK = cv2.imencode(".png", np.zeros((80, 96), np.uint8))[1].tobytes()
DEPTH = cv2.imencode(".png", np.full((80, 96), 60, np.uint16))[1].tobytes()
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{n}: &{n} [{','.join(['*' + p] * 9)}]\n" for p, n in zip("abcdefgh", "bcdefghi", strict=True)
)
TAG = "K_left: !!python/object/apply:os.system ['touch executed']\n"

CALIBRATIONS = [
    Case("no calibration", beside("--calibration", "c.yaml"), ("c.yaml", "o such file")),
    Case("a calibration of another kind", calibrated("c.txt", "x"), ("c.txt", "named values")),
    Case("an empty calibration", calibrated("c.yaml", ""), ("c.yaml", "named values")),
    Case("a calibration that is a list", calibrated("c.json", "[1, 2]"), ("c.json", "list")),
    Case("YAML aliases that explode", calibrated("c.yaml", BOMB), ("c.yaml", "aliases")),
    Case("YAML that executes", calibrated("c.yaml", TAG), ("c.yaml", "python/object")),
    Case("YAML nested without end", calibrated("c.yaml", NESTED), ("c.yaml", "nested")),
    Case("YAML that contains itself", calibrated("c.yaml", "a: &a [*a]"), ("c.yaml", "itself")),
    Case("JSON nested without end", calibrated("c.json", NESTED), ("c.json",)),
    Case(
        "a matrix of 10^9 rows", calibrated("c.yaml", "K: {rows: 1000000000, cols: 1000000000, data: [1]}"), ("c.yaml",)
    ),
    Case(
        "a matrix of NaN",
        eyes(K_left=[[float("nan"), 0, 1], [0, 90, 1], [0, 0, 1]]),
        ("c.json", "k of the left camera"),
    ),
    Case("a matrix in words", eyes(K_left="wide"), ("c.json", "kleft")),
    Case(
        "a matrix of 10^400", calibrated("c.json", '{"K": [[1' + "0" * 400 + ",0,1],[0,1,1],[0,0,1]]}"), ("c.json", "k")
    ),
    Case("a focal length below 0", eyes(K_left=[[-9, 0, 1], [0, 90, 1], [0, 0, 1]]), ("c.json", "camera matrix")),
    Case(
        "a matrix beyond all bounds", eyes(K_left=[[1e200, 0, 1], [0, 90, 1], [0, 0, 1]]), ("c.json", "camera matrix")
    ),
    Case("R that is no rotation", eyes(R=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), ("c.json", "rotation")),
    Case("eyes in one place", eyes(T_mm=[0, 0, 0]), ("c.json", "baseline")),
    Case("eyes exchanged", eyes(T_mm=[4, 0, 0]), ("c.json", "swapped")),
    Case("eyes a meter apart", eyes(T_mm=[-1000, 0, 0]), ("c.json", "baseline")),
    Case("a size of infinity", eyes(width=float("inf")), ("c.json", "width")),
    Case("a size in words", eyes(width="wide"), ("c.json", "width")),
    Case(
        "a baseline in words",
        calibrated("c.json", json.dumps({"fx": 9, "fy": 9, "cx": 5, "cy": 5, "baseline_mm": "x"})),
        ("c.json", "baselinemm"),
    ),
    Case(
        "a center in words", calibrated("c.json", json.dumps({"fx": 9, "fy": 9, "cx": "x", "cy": 5})), ("c.json", "cx")
    ),
    Case("pixel centers in words", eyes(pixel_center="half"), ("c.json", "pixelcenter")),
    Case("seven distortions", eyes(distortion_left=[0] * 7), ("c.json", "distortion")),
    Case("an archive of pickles", calibrated("c.npz", executing_pickle()), ("c.npz", "pickle")),
    Case(
        "a calibration that unfolds to 2 GB",
        beside("--calibration", "c.npz", lambda f: (f / "c.npz").write_bytes(npz_bomb(("K",)))),  # made late
        ("c.npz", "1024 MB"),
    ),
    Case("an ini of words", calibrated("c.ini", "[StereoLeft]\nfc_x=wide\n"), ("c.ini",)),
    Case("an ini without sections", calibrated("c.ini", "fc_x=1"), ("c.ini",)),
    Case("an ini of one eye", calibrated("c.ini", "[StereoLeft]\nfc_x=1\nfc_y=1\ncc_x=1\ncc_y=1\n"), ("c.ini",)),
    Case(
        "a folder for a calibration",
        beside("--calibration", "c.yaml", empty_folder("c.yaml")),
        ("c.yaml", "a folder"),
    ),
    Case(
        "a pipe for a calibration",
        beside("--calibration", "c.yaml", pipe("c.yaml")),
        ("c.yaml", "pipe"),
    ),
]
PARTS = [
    Case("no folder of masks", beside("--masks", "masks"), ("masks", "no such folder")),
    Case("a mask name of 5000 letters", beside("--masks", "m" * 5000), ("mmm", "too long")),
    Case("too few masks", beside("--masks", "masks", put("masks/a.png", MASK)), ("masks", "1 files for 10 frames")),
    Case(
        "pictures for masks",
        beside(
            "--masks", "masks", ten("masks", cv2.imencode(".png", cv2.resize(NOISE, (96, 80)))[1].tobytes(), ".png")
        ),
        ("masks/0.png", "a mask"),
    ),
    Case(
        "masks of another size",
        beside("--masks", "masks", ten("masks", cv2.imencode(".png", NOISE[..., 0] // 128)[1].tobytes(), ".png")),
        ("masks/0.png", "96x80", "48x40"),
    ),
    Case(
        "a mask that is a bomb in the middle",
        beside("--masks", "masks", ten("masks", MASK, ".png", png_bomb())),
        ("masks/9.png", "60000x60000"),
    ),
    Case(
        "masks as pickles", beside("--masks", "masks", ten("masks", pickled_npy(), ".npy")), ("masks/0.npy", "pickle")
    ),
    Case(
        "masks that promise terabytes",
        beside("--masks", "masks", ten("masks", lying_npy("(80, 96000000000)", "'|b1'"), ".npy")),
        ("masks/0.npy", "64 bytes"),
    ),
    Case("depth without a unit", beside("--depth", "d", ten("d", DEPTH, ".png")), ("--depth-unit-mm", "none")),
    Case(
        "depth of nothing but zeros",
        beside(
            "--depth",
            "d",
            ten("d", cv2.imencode(".png", np.zeros((80, 96), np.uint16))[1].tobytes(), ".png"),
            more="--depth-unit-mm 1",
        ),
        leaves=("out",),
    ),
    Case(
        "depth that is text",
        beside("--depth", "d", ten("d", b"hello", ".tiff"), more="--depth-unit-mm 1"),
        ("d/0.tiff",),
    ),
    Case(
        "depth in meters called mm",
        beside(
            "--depth",
            "d",
            ten("d", whole_npy(np.full((80, 96), 0.06, np.float32)), ".npy"),
            more="--depth-unit-mm 1",
        ),
        ("--depth-unit-mm", "mm in d"),
    ),
    Case(
        "half an EXR",
        beside("--depth", "d", ten("d", b"v/1\x01\x02\0\0\0channels\0", ".exr"), more="--depth-unit-mm 1"),
        ("d/0.exr",),
    ),
    Case("no file of poses", beside("--poses", "p.npy"), ("p.npy", "o such file")),
    Case(
        "poses of another clip",
        moving(np.tile(np.eye(4), (5, 1, 1))),
        ("p.npy", "(10, 4, 4)", "(5, 4, 4)"),
    ),
    Case(
        "poses that scale",
        moving(np.tile(2 * np.eye(4), (10, 1, 1))),
        ("p.npy", "rotation"),
    ),
    Case(
        "poses of NaN",
        moving(np.full((10, 4, 4), np.nan)),
        ("p.npy",),
    ),
    Case(
        "poses in words",
        moving(np.full((10, 4, 4), "x")),
        ("p.npy",),
    ),
    Case("poses as a pickle", beside("--poses", "p.npy", put("p.npy", pickled_npy())), ("p.npy", "pickle")),
    Case(
        "a STIR clip without spots",
        beside("--stir", "seq", empty_folder("seq"), more="--depth shading"),
        ("seq", "STIR"),
    ),
    Case("a network that is nowhere", beside("--depth", "depth-anything:./nowhere"), ("nowhere",)),
    Case(
        "a network of garbage",
        beside("--depth", "depth-anything:net", put("net/config.json", "{"), put("net/model.safetensors", "x")),
        ("net",),
    ),
    Case("the video is the output", preparing("clip.mkv"), ("clip.mkv", "a file")),
    Case("an output that is in use", preparing("out", put("out/x", "x")), ("out", "files in it")),
    Case("an output below a file", preparing("clip.mkv/out"), ("clip.mkv/out", "a path")),
    Case("an output where nothing can be", preparing("/proc/x/out"), ("/proc/x/out", "a path")),
    Case("an output of no name", preparing(""), ("empty",)),
    Case("an output inside the pictures", pictures_folder(out="clip/out"), leaves=("clip/out", "clip")),
]
CASES = [*CALIBRATIONS, *PARTS]
