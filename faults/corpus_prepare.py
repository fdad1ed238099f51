"""What `prepare` is given beside the video: calibrations, masks, depth, poses, and places to write to."""

from __future__ import annotations

import json

import cv2
import numpy as np
from corpus_case import Build, Case, Step, given
from corpus_damage import (
    HALF_EXR,
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


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def calibrated(name: str, content: bytes | str) -> Build:
    return given(f"prepare clip.mkv out --calibration {name} {PLAIN}", put(name, content), needs="video")


def eyes(**changes: object) -> Build:
    """A calibration of two eyes with some entries changed; its layout is stated, for the video shows one camera."""
    return calibrated("c.json", json.dumps(EYES | {"layout": "interlaced"} | changes))


def beside(option: str, name: str, *steps: Step, more: str = "") -> Build:
    words, given_already = PLAIN.split(), (option, *more.split())
    kept = [word for pair in zip(words[::2], words[1::2], strict=True) if pair[0] not in given_already for word in pair]
    return given(["prepare", "clip.mkv", "out", option, name, *more.split(), *kept], *steps, needs="video")


def ten(folder: str, content: bytes, suffix: str, last: bytes = b"") -> Step:
    """Ten equal files, but for the last if it is given."""
    return lambda place: [put(f"{folder}/{i}{suffix}", last if last and i == 9 else content)(place) for i in range(10)]


def lens(focal: float) -> list[list[float]]:
    return [[focal, 0, 1], [0, 90, 1], [0, 0, 1]]


def yaml_case(name: str, content: str, *says: str) -> Case:
    return Case(name, calibrated("c.yaml", content), ("c.yaml", *says))


def json_case(name: str, content: object, *says: str) -> Case:
    text = content if isinstance(content, str) else json.dumps(content)
    return Case(name, calibrated("c.json", text), ("c.json", *says))


def eyes_case(name: str, says: str, **changes: object) -> Case:
    return Case(name, eyes(**changes), ("c.json", says))


def ini_case(name: str, content: str) -> Case:
    return Case(name, calibrated("c.ini", content), ("c.ini",))


def masks_case(name: str, content: bytes, *says: str, suffix: str = ".png", last: bytes = b"") -> Case:
    return Case(name, beside("--masks", "masks", ten("masks", content, suffix, last)), says)


def depth_case(name: str, content: bytes, suffix: str, *says: str, leaves: tuple[str, ...] = ()) -> Case:
    """Ten depth files in mm."""
    return Case(name, beside("--depth", "d", ten("d", content, suffix), more="--depth-unit-mm 1"), says, leaves)


def poses_case(name: str, poses: np.ndarray, *says: str) -> Case:
    return Case(name, beside("--poses", "p.npy", lambda f: np.save(f / "p.npy", poses)), ("p.npy", *says))


def preparing(out: str, *steps: Step) -> Build:
    return given(["prepare", "clip.mkv", out, *PLAIN.split()], *steps, needs="video")


DEPTH = png(np.full((80, 96), 60, np.uint16))
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{n}: &{n} [{','.join(['*' + p] * 9)}]\n" for p, n in zip("abcdefgh", "bcdefghi", strict=True)
)
TAG = "K_left: !!python/object/apply:os.system ['touch executed']\n"
ONE_EYE = {"fx": 9, "fy": 9, "cx": 5, "cy": 5}
WIDE_NPY, METERS = lying_npy("(80, 96000000000)", "'|b1'"), whole_npy(np.full((80, 96), 0.06, np.float32))
GARBAGE = put("net/config.json", "{"), put("net/model.safetensors", "x")
TEN_EYES = np.tile(np.eye(4), (10, 1, 1))

CALIBRATIONS = [
    Case("no calibration", beside("--calibration", "c.yaml"), ("c.yaml", "o such file")),
    Case("a calibration of another kind", calibrated("c.txt", "x"), ("c.txt", "named values")),
    yaml_case("an empty calibration", "", "named values"),
    json_case("a calibration that is a list", "[1, 2]", "list"),
    yaml_case("YAML aliases that explode", BOMB, "aliases"),
    yaml_case("YAML that executes", TAG, "python/object"),
    yaml_case("YAML nested without end", NESTED, "nested"),
    yaml_case("YAML that contains itself", "a: &a [*a]", "itself"),
    json_case("JSON nested without end", NESTED),
    yaml_case("a matrix of 10^9 rows", "K: {rows: 1000000000, cols: 1000000000, data: [1]}"),
    eyes_case("a matrix of NaN", "k of the left camera", K_left=lens(float("nan"))),
    eyes_case("a matrix in words", "kleft", K_left="wide"),
    json_case("a matrix of 10^400", '{"K": [[1' + "0" * 400 + ",0,1],[0,1,1],[0,0,1]]}", "k"),
    eyes_case("a focal length below 0", "camera matrix", K_left=lens(-9)),
    eyes_case("a matrix beyond all bounds", "camera matrix", K_left=lens(1e200)),
    eyes_case("R that is no rotation", "rotation", R=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]),
    eyes_case("eyes in one place", "baseline", T_mm=[0, 0, 0]),
    eyes_case("eyes exchanged", "swapped", T_mm=[4, 0, 0]),
    eyes_case("eyes a meter apart", "baseline", T_mm=[-1000, 0, 0]),
    eyes_case("a size of infinity", "width", width=float("inf")),
    eyes_case("a size in words", "width", width="wide"),
    json_case("a baseline in words", ONE_EYE | {"baseline_mm": "x"}, "baselinemm"),
    json_case("a center in words", ONE_EYE | {"cx": "x"}, "cx"),
    eyes_case("pixel centers in words", "pixelcenter", pixel_center="half"),
    eyes_case("seven distortions", "distortion", distortion_left=[0] * 7),
    Case("an archive of pickles", calibrated("c.npz", executing_pickle()), ("c.npz", "pickle")),
    Case(
        "a calibration that unfolds to 2 GB",
        beside("--calibration", "c.npz", lambda f: (f / "c.npz").write_bytes(npz_bomb(("K",)))),  # made late
        ("c.npz", "1024 MB"),
    ),
    ini_case("an ini of words", "[StereoLeft]\nfc_x=wide\n"),
    ini_case("an ini without sections", "fc_x=1"),
    ini_case("an ini of one eye", "[StereoLeft]\nfc_x=1\nfc_y=1\ncc_x=1\ncc_y=1\n"),
    Case(
        "a folder for a calibration", beside("--calibration", "c.yaml", empty_folder("c.yaml")), ("c.yaml", "a folder")
    ),
    Case("a pipe for a calibration", beside("--calibration", "c.yaml", pipe("c.yaml")), ("c.yaml", "pipe")),
]
MASK = png(np.zeros((80, 96), np.uint8))
PARTS = [
    Case("no folder of masks", beside("--masks", "masks"), ("masks", "no such folder")),
    Case("a mask name of 5000 letters", beside("--masks", "m" * 5000), ("mmm", "too long")),
    Case("too few masks", beside("--masks", "masks", put("masks/a.png", MASK)), ("masks", "1 files for 10 frames")),
    masks_case("pictures for masks", png(cv2.resize(NOISE, (96, 80))), "masks/0.png", "a mask"),
    masks_case("masks of another size", png(NOISE[..., 0] // 128), "masks/0.png", "96x80", "48x40"),
    masks_case("a mask that is a bomb in the middle", MASK, "masks/9.png", "60000x60000", last=png_bomb()),
    masks_case("masks as pickles", pickled_npy(), "masks/0.npy", "pickle", suffix=".npy"),
    masks_case("masks that promise terabytes", WIDE_NPY, "masks/0.npy", "64 bytes", suffix=".npy"),
    Case("depth without a unit", beside("--depth", "d", ten("d", DEPTH, ".png")), ("--depth-unit-mm", "none")),
    depth_case("depth of nothing but zeros", png(np.zeros((80, 96), np.uint16)), ".png", leaves=("out",)),
    depth_case("depth that is text", b"hello", ".tiff", "d/0.tiff"),
    depth_case("depth in meters called mm", METERS, ".npy", "--depth-unit-mm", "mm in d"),
    depth_case("half an EXR", HALF_EXR, ".exr", "d/0.exr"),
    Case("no file of poses", beside("--poses", "p.npy"), ("p.npy", "o such file")),
    poses_case("poses of another clip", TEN_EYES[:5], "(10, 4, 4)", "(5, 4, 4)"),
    poses_case("poses that scale", 2 * TEN_EYES, "rotation"),
    poses_case("poses of NaN", np.nan * TEN_EYES),
    poses_case("poses in words", np.full((10, 4, 4), "x")),
    Case("poses as a pickle", beside("--poses", "p.npy", put("p.npy", pickled_npy())), ("p.npy", "pickle")),
    Case(
        "a STIR clip of no spots", beside("--stir", "seq", empty_folder("seq"), more="--depth shading"), ("seq", "STIR")
    ),
    Case("a network that is nowhere", beside("--depth", "depth-anything:./nowhere"), ("nowhere",)),
    Case("a network of garbage", beside("--depth", "depth-anything:net", *GARBAGE), ("net",)),
    Case("the video is the output", preparing("clip.mkv"), ("clip.mkv", "got the input")),
    Case("an output that is in use", preparing("out", put("out/x", "x")), ("out", "files in it")),
    Case("an output below a file", preparing("clip.mkv/out"), ("clip.mkv/out", "a path")),
    Case("an output where nothing can be", preparing("/proc/x/out"), ("/proc/x/out", "a path")),
    Case("an output of no name", preparing(""), ("empty",)),
    Case("an output inside the pictures", pictures_folder(out="clip/out"), leaves=("clip/out", "clip")),
]
CASES = [*CALIBRATIONS, *PARTS]
