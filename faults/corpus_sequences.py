"""Sequence folders of every layout, their poses and facts, broken in every way that has been thought of."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import cv2
import numpy as np
from corpus_case import Case, given
from corpus_damage import (
    CHECK,
    DRAWS,
    FLIPPED,
    HALF_EXR,
    HALF_JPEG,
    IMAGE,
    NESTED,
    NOISE,
    SOUND,
    Step,
    closed,
    damaged,
    described,
    empty_folder,
    entry,
    everywhere,
    executing_pickle,
    first_frames,
    instead,
    jpeg_bomb,
    jpeg_of_two_sizes,
    link,
    lying_npy,
    made,
    npy,
    npz_bomb,
    pickled_npy,
    picture,
    pipe,
    png_bomb,
    poses,
    put,
    sized,
    tiff_bomb,
    whole_npy,
    without,
)


def scared(data: Path) -> None:
    """A processed keyframe of two frames."""
    for i in range(2):
        name = f"frame_data{i:06d}"
        lens = [[30, 0, 24], [0, 30, 20], [0, 0, 1]]
        record = {"camera-calibration": {"KL": lens}, "camera-pose": np.eye(4).tolist()}
        put(f"data/frame_data/{name}.json", json.dumps(record))(data)
        picture(f"data/left_finalpass/{name}.png", NOISE)(data)
        picture(f"data/disparity/{name}.tiff", np.full((40, 48), 2, np.float32))(data)
        q = [[1, 0, 0, -24], [0, 1, 0, -20], [0, 0, 0, 30], [0, 0, 0.25, 0]]
        put(f"data/reprojection_data/{name}.json", json.dumps({"reprojection-matrix": q}))(data)


def c3vd(data: Path) -> None:
    """Two frames with a lens of their own."""
    for i in range(2):
        picture(f"{i}_color.png", NOISE)(data)
        picture(f"{i:04d}_depth.tiff", np.full((40, 48), 30000, np.uint16))(data)
    put("pose.txt", "\n".join([",".join(map(str, np.eye(4).T.ravel()))] * 2))(data)
    lens = {"width": 48, "height": 40, "cx": 23.5, "cy": 19.5, "a0": 27, "a2": -0.02, "a3": 0, "a4": 0}
    put("config.ini", "".join(f"{k} = {v}\n" for k, v in (lens | {"c": 1, "d": 0, "e": 0}).items()))(data)


def hamlyn(data: Path) -> None:
    """Two frames of `rectifiedNN`."""
    for i in range(2):
        picture(f"image01/{i}.jpg", NOISE)(data)
        picture(f"depth01/{i}.png", np.full((40, 48), 60, np.uint16))(data)
    put("intrinsics.txt", "40 0 24\n0 40 20\n0 0 1\n")(data)


def stereomis(data: Path) -> None:
    """What makes a sound sequence one of StereoMIS."""
    test = [1, 9]
    train = [i for i in range(17) if i not in test]
    put("split.json", json.dumps({"test_indices": test, "train_indices": train}))(data)
    np.save(data / "intrinsics.npy", np.array([[50.0, 0, 24], [0, 50, 20], [0, 0, 1]]))


def everywhere_npy(value: float) -> Step:
    content = whole_npy(np.full((40, 48), value, np.float32))
    return lambda data: [put(f"depth/{i}.npy", content)(data) for i in range(3)]


def changed(name: str, old: str, new: str) -> Step:
    return lambda data: (data / name).write_bytes((data / name).read_bytes().replace(old.encode(), new.encode()))


def narrow(data: Path) -> None:
    """Names of Forplane, and pictures that are too narrow for it."""
    (data / "masks").rename(data / "gt_masks")
    (data / "depth").rename(data / "gt_depth")
    everywhere("images", NOISE[:, :30])(data)


TRAIN = "train data out"
LENS, SPLIT = "intrinsics.txt", "split.json"
FIRST, LAST = "images/000000.png", "frame_data000001.json"
SHORT = f"{TRAIN} --init-budget 100 --schedule.coarse-iterations 2 --schedule.fine-iterations 3 --no-networks"
MASKED = everywhere("masks", np.full((40, 48), 255, np.uint8))
PLAIN = sized(48, 40, True)
BAD_POSE = json.dumps({"camera-calibration": {"KL": np.eye(3).tolist()}, "camera-pose": [[np.nan] * 4] * 4})
LAST_FACTS, LAST_Q = f"data/frame_data/{LAST}", f"data/reprojection_data/{LAST}"
HUGE_Q = '{"reprojection-matrix": [[1' + "0" * 400 + "]]}"
NAN_POSES, NAN_LENS = "\n".join([",".join(["nan"] * 16)] * 2), "nan 0 1\n0 nan 1\n0 0 1"
DEEP_NPY = lying_npy("(40, 48000000000)", "'<f4'")
UNMEASURED = everywhere("depth", np.zeros((40, 48), np.uint16))
NARROW_TIFF, WIDE_TIFF = struct.pack("<HHII", 256, 3, 1, 48), struct.pack("<HHII", 256, 4, 1, 1 << 24)
LYING_TIFF = cv2.imencode(".tiff", NOISE)[1].tobytes().replace(NARROW_TIFF, WIDE_TIFF)
ALPHABETS, NO_TEXT = "dé tà\n☃ 'x'", os.fsdecode(b"\xff\xfe")


def moved(name: str) -> Step:
    return lambda folder: (folder / "data").rename(folder / name)


FOLDERS = [
    Case("no folder", given(CHECK), ("data", "no such folder")),
    Case("an empty folder", made(), ("data", "an empty folder")),
    Case("a file for a sequence", given(CHECK, put("data", "x")), ("data", "a file")),
    Case("a pipe for a sequence", given(CHECK, pipe("data")), ("data", "pipe")),
    Case("a link to itself", given(CHECK, link("data", "data")), ("data", "no such folder")),
    Case("a name of 5000 letters", given("check " + "x" * 5000), ("xxx", "too long")),
    Case("a closed folder", damaged(closed("images")), ("images", "ermission"), needs_user=True),
    Case("no pictures", damaged(without("images"), empty_folder("images")), ("images", "none")),
    Case("pictures of another kind", damaged(instead("images")), ("images",)),
    Case("no masks", damaged(without("masks")), ("masks", "no such folder")),
    Case("a file for the depth folder", damaged(instead("depth")), ("depth",)),
    Case("one frame", damaged(first_frames(1)), ("images", "at least 2 frames")),
    Case("two frames", damaged(first_frames(2)), leaves=DRAWS),
    Case("a mask too few", damaged(without("masks/000003.png")), leaves=DRAWS),
    Case("a link to nowhere", damaged(link(IMAGE, "/nowhere.png")), (IMAGE, "o such file")),
    Case("a picture that links to itself", damaged(link(IMAGE, "000003.png")), (IMAGE, "o such file")),
    Case("a pipe for a picture", damaged(pipe(IMAGE)), (IMAGE, "pipe")),
    Case("a pipe for a mask", damaged(pipe("masks/000000.png")), ("masks/000000.png", "pipe")),
    Case("an endless device for a picture", damaged(link(IMAGE, "/dev/zero")), (IMAGE, "device")),
    Case("an endless device for poses", damaged(link("poses_bounds.npy", "/dev/zero")), ("poses_bounds.npy", "device")),
    Case("an endless device for facts", damaged(link("sequence.json", "/dev/zero")), ("sequence.json", "device")),
    Case("a folder for a picture", damaged(instead(IMAGE)), (IMAGE, "a folder")),
    Case("a folder for the poses", damaged(instead("poses_bounds.npy")), ("poses_bounds.npy", "a folder")),
    Case("a closed picture", damaged(closed(IMAGE)), (IMAGE, "ermission"), needs_user=True),
    Case(
        "names of many alphabets",
        given(["check", ALPHABETS], moved(ALPHABETS), needs="sequence"),
        leaves=(f"{ALPHABETS}_check.png",),
    ),
    Case(
        "a name that is no text",
        given(["check", NO_TEXT], moved(NO_TEXT), needs="sequence"),
        leaves=(f"{NO_TEXT}_check.png",),
    ),
    Case("digits that are none", damaged(lambda d: (d / IMAGE).rename(d / "images/000003²٣.png")), leaves=DRAWS),
    Case("a sequence of 1x1 px", made(sized(1, 1)), leaves=DRAWS),
]
PICTURES = [
    Case("a picture cut short", damaged(put(IMAGE, SOUND[:200])), (IMAGE, "cannot be decoded")),
    Case("an empty picture", damaged(put(IMAGE, b"")), (IMAGE, "cannot be decoded")),
    Case("a text called .png", damaged(put(IMAGE, "hello")), (IMAGE, "cannot be decoded")),
    Case("a bit flipped", damaged(put(IMAGE, FLIPPED)), (IMAGE, "cannot be decoded")),
    Case("half a JPEG called .png", damaged(put(IMAGE, HALF_JPEG)), (IMAGE, "cannot be decoded")),
    Case("a decompression bomb", damaged(put(IMAGE, png_bomb())), (IMAGE, "60000x60000")),
    Case("a bomb as the first picture", damaged(put(FIRST, png_bomb(40000, 30000))), (FIRST, "40000x30000")),
    Case("a mask that is a bomb", damaged(put("masks/000003.png", png_bomb())), ("masks/000003.png", "60000x60000")),
    Case("a promise of 9 Mpx not kept", damaged(put(IMAGE, png_bomb(3000, 3000))), (IMAGE, "decoded"), noise="libpng"),
    Case("a TIFF that promises too much", damaged(put(IMAGE, LYING_TIFF)), (IMAGE, "16777216x40")),
    Case("a JPEG of 4 Gpx in 2 KB", damaged(put(IMAGE, jpeg_bomb())), (IMAGE, "65500x65500")),
    Case("a JPEG of two sizes", damaged(put(IMAGE, jpeg_of_two_sizes())), (IMAGE, "cannot be decoded")),
    Case("a TIFF of two sizes", damaged(put(IMAGE, tiff_bomb((20000, 20000), (48, 40)))), (IMAGE, "20000x20000")),
    Case("another size", damaged(picture(IMAGE, NOISE[:30])), (IMAGE, "48x40", "48x30")),
    Case("16-bit color", damaged(picture(IMAGE, NOISE.astype(np.uint16))), (IMAGE, "16-bit")),
    Case("a gray picture", damaged(picture(IMAGE, NOISE[..., 0])), (IMAGE, "1 channel")),
    Case("a smooth mask", damaged(picture("masks/000003.png", NOISE[..., 0])), ("masks/000003.png", "0 and 255")),
    Case("a mask of 0 and 1", damaged(picture("masks/000003.png", NOISE[..., 0] // 128)), ("masks/000003.png", "255")),
    Case("a colored mask", damaged(picture("masks/000003.png", NOISE)), ("masks/000003.png", "one channel")),
    Case("tools everywhere, checked", damaged(MASKED, command=f"{CHECK} --strict"), ("data", "no errors"), DRAWS),
    Case("tools everywhere, trained", damaged(MASKED, command=TRAIN), ("masks", "tissue")),
    Case("no depth at all", damaged(UNMEASURED, command=TRAIN), ("depth", "depth > 0")),
    Case("depth of NaN", made(PLAIN, everywhere_npy(np.nan), command=TRAIN), ("depth", "depth > 0")),
    Case("depth as a color map", damaged(picture("depth/000003.png", NOISE)), ("depth/000003.png", "one channel")),
    Case("depth of infinity", made(PLAIN, everywhere_npy(np.inf), command=TRAIN), ("depth", "depth > 0")),
    Case("pictures of 1x1 px, trained", made(sized(1, 1), command=SHORT), ("initialization", "4 tissue pixels")),
    Case("pictures of 2x2 px, trained", made(sized(2, 2), command=SHORT), leaves=("out",)),
    Case("pictures of 5x4 px, checked", made(sized(5, 4)), leaves=DRAWS),
    Case("three frames, trained", made(sized(48, 40), command=SHORT), leaves=("out",)),
]
LAYOUTS = [
    Case("a raw SCARED keyframe", made(put("data/frame_data.tar.gz", b"x")), ("frame_data", "SCARED")),
    Case("SCARED without disparity", made(scared, without("data/disparity")), ("disparity",)),
    Case("SCARED with a pose of NaN", made(scared, put(LAST_FACTS, BAD_POSE)), (LAST, "camera-pose", "NaN")),
    Case("SCARED nested without end", made(scared, put(LAST_FACTS, NESTED)), (LAST,)),
    Case("SCARED with a huge number", made(scared, put(LAST_Q, HUGE_Q)), (LAST, "reprojection-matrix")),
    Case("C3VD without a depth", made(c3vd, without("0001_depth.tiff")), ("0001_depth.tiff",)),
    Case("C3VD with words for poses", made(c3vd, put("pose.txt", "a,b,c")), ("pose.txt", "rows of numbers")),
    Case("C3VD with poses of NaN", made(c3vd, put("pose.txt", NAN_POSES)), ("pose.txt", "NaN")),
    Case("C3VD with a lens that is none", made(c3vd, changed("config.ini", "-0.02", "1e300")), ("data", "fx")),
    Case("C3VD of another size", made(c3vd, without("config.ini")), ("0_color.png", "1350x1080")),
    Case("Hamlyn without a camera", made(hamlyn, without("intrinsics.txt")), ("intrinsics.txt",)),
    Case("Hamlyn with a camera of NaN", made(hamlyn, put(LENS, NAN_LENS)), (LENS, "camera matrix")),
    Case("Forplane, too narrow", damaged(narrow), ("poses_bounds.npy", "30x40 px", "48x40")),
    Case("a raw StereoMIS sequence", made(put("StereoCalibration.ini", "x")), ("StereoCalibration.ini", "prepare")),
    Case(
        "StereoMIS with other splits", damaged(stereomis, put(SPLIT, '{"test_indices": [0]}')), (SPLIT, "test_indices")
    ),
    Case("StereoMIS with a lying camera", damaged(stereomis, put("intrinsics.npy", lying_npy())), ("intrinsics.npy",)),
    Case("a STIR clip without depth", made(put("segmentation/icgstartseg.png", b"x")), ("data", "prepare")),
    Case("plain with depth as a bomb", made(PLAIN, put("depth/2.npy", DEEP_NPY)), ("depth/2.npy", "64 bytes")),
    Case("plain with half an EXR", made(PLAIN, without("depth/2.npy"), put("depth/2.exr", HALF_EXR)), ("depth/2.exr",)),
    Case("plain, sound", made(PLAIN), leaves=DRAWS, check=lambda f: (f / "data_check.png").stat().st_size > 1000),
]
POSES, FACTS = "poses_bounds.npy", "sequence.json"


def stored(name: str, path: str, content: bytes | str, *says: str) -> Case:
    return Case(name, damaged(put(path, content)), (path, *says))


NUMBERS = [
    Case("no poses", damaged(without(POSES)), (POSES, "no such file")),
    Case("poses of another length", damaged(poses(lambda p: p[:5])), (POSES, "(17, 17)", "(5, 17)")),
    Case("NaN in a pose", damaged(entry(3, 1, np.nan)), (POSES, "NaN")),
    Case("infinity in a pose", damaged(entry(3, 8, np.inf)), (POSES, "infinity")),
    Case("a pose that scales", damaged(entry(2, 0, 2.0)), (POSES, "rotations", "row 2")),
    Case("a pose that mirrors", damaged(entry(2, 0, -1.0)), (POSES, "rotations", "row 2")),
    Case("a camera beyond all bounds", damaged(entry(2, 3, 1e300)), ("data", "1e+300 mm", "frame 2")),
    Case("a focal length of 0 in a pose", damaged(entry(0, 14, 0.0), described(fx=None)), (POSES, "focal")),
    stored("poses in a pickle", POSES, executing_pickle(), "pickle"),
    stored("poses as objects", POSES, pickled_npy(), "pickle"),
    stored("an empty file of poses", POSES, b"", "empty"),
    stored("a shape of terabytes", POSES, lying_npy(), "64 bytes"),
    stored("a negative shape", POSES, lying_npy("(-17, 17)"), "-17"),
    stored("a shape of words", POSES, lying_npy("('a', 'b')"), "shape"),
    stored("a header nested without end", POSES, npy("-" * 9000 + "1")),
    stored("a header that is code", POSES, npy("__import__('os').system('touch executed')")),
    Case("a record in place of numbers", damaged(poses(lambda p: np.zeros(17, [("a", "f8")]))), (POSES,)),
    Case("words in place of numbers", damaged(poses(lambda p: np.full((17, 17), "x"))), (POSES, "finite")),
    Case(
        "an archive that unfolds to 2 GB",
        damaged(lambda d: (d / POSES).write_bytes(npz_bomb())),  # made late: it takes seconds
        (POSES, "1024 MB"),
    ),
    stored("an archive cut short", POSES, b"PK\x03\x04" + bytes(50), "zip"),
    stored("facts that are not JSON", FACTS, "{", "JSON"),
    stored("facts that are a list", FACTS, "[1]", "list"),
    stored("facts nested without end", FACTS, NESTED, "JSON"),
    stored("facts of bytes", FACTS, bytes(range(256)), "JSON"),
    stored("a number of 5000 digits", FACTS, '{"fx": ' + "9" * 5000 + "}", "digits"),
    stored("a focal length of 10^400", FACTS, '{"fx": 1' + "0" * 400 + "}", "fx"),
    Case("a focal length of NaN", damaged(described(fx=float("nan"))), (FACTS, "fx", "nan")),
    Case("a focal length of 1e300", damaged(described(fx=1e300)), (FACTS, "fx", "1e+300")),
    Case("a focal length in words", damaged(described(fx="fifty")), (FACTS, "fx", "fifty")),
    Case("facts of another size", damaged(described(width=640, height=512)), (FACTS, "48x40", "640x512")),
    Case("a unit nobody knows", damaged(described(depth_unit="inch")), (FACTS, "depth_unit", "inch")),
    Case("a format from the future", damaged(described(format_version=99)), (FACTS, "format_version")),
    Case("a depth scale of infinity", damaged(described(depth_scale=float("inf"))), (FACTS, "depth_scale")),
    Case("frames that are not there", damaged(described(unexplained_frames=[99])), (FACTS, "99")),
    Case("a mask value nobody knows", damaged(described(mask_tool_value=7)), (FACTS, "mask_tool_value")),
]
CASES = [*FOLDERS, *PICTURES, *LAYOUTS]
