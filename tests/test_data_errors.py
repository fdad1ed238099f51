"""One clear line for everything that can be wrong with a sequence folder."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from reader_checks import assert_damage_is_rejected
from sequence_edits import change_poses, describe, write

from endoprior.core.checks import InputError
from endoprior.data import load_sequence

# Damage to the folder, file named in the message, words in it.


def remove(name):
    return lambda folder: shutil.rmtree(folder / name)


def empty(name):
    return lambda folder: [file.unlink() for file in (folder / name).iterdir()]


def delete(name):
    return lambda folder: (folder / name).unlink()


def a_folder(name):
    return lambda folder: ((folder / name).unlink(), (folder / name).mkdir())


def replaced(name, pixels):
    return lambda folder: write(folder / name, pixels)


def replaced_in_all(name, pixels):
    return lambda folder: [write(file, pixels) for file in (folder / name).iterdir()]


def jpeg_only(folder):
    for file in (folder / "images").iterdir():
        write(file.with_suffix(".jpg"), cv2.imread(str(file)))
        file.unlink()


def one_frame(folder):
    for name in ("images", "masks", "depth"):
        for file in sorted((folder / name).iterdir())[1:]:
            file.unlink()
    change_poses(folder, lambda p: p[:1])


def cut_short(folder):
    file = folder / "images/000004.png"
    file.write_bytes(file.read_bytes()[:200])


def poses(change):
    return lambda folder: change_poses(folder, change)


def pose_entry(row, column, value):
    def change(p):
        p[row, column] = value
        return p

    return poses(change)


def without_fx(change):
    def both(folder):
        describe(folder, fx=None)
        change(folder)

    return both


SIZE = (40, 48)
AT_LOAD = {
    "no such folder": (shutil.rmtree, "tiny", "no such folder"),
    "a file": (lambda f: (shutil.rmtree(f), f.write_text("")), "tiny", "got a file"),
    "no images": (remove("images"), "images", "no such folder"),
    "no masks": (remove("masks"), "masks", "no such folder"),
    "empty images": (empty("images"), "images", "got none"),
    "empty depth": (empty("depth"), "depth", "got none"),
    "jpeg": (jpeg_only, "images", "only .jpg"),
    "one frame": (one_frame, "images", "at least 2 frames"),
    "first image unreadable": (lambda f: (f / "images/000000.png").write_bytes(b"x"), "000000.png", "1 bytes"),
    "first image empty": (lambda f: (f / "images/000000.png").write_bytes(b""), "000000.png", "0 bytes"),
    "no poses": (delete("poses_bounds.npy"), "poses_bounds.npy", "no such file"),
    "poses of other count": (poses(lambda p: p[:5]), "poses_bounds.npy", "expected shape (17, 17), got (5, 17)"),
    "poses of other width": (poses(lambda p: p[:, :15]), "poses_bounds.npy", "got (17, 15)"),
    "poses not numbers": (poses(lambda p: p.astype(str)), "poses_bounds.npy", "finite numbers"),
    "poses not an array": (lambda f: (f / "poses_bounds.npy").write_text("x"), "poses_bounds.npy", "a NumPy file"),
    "pose NaN": (pose_entry(3, 7, np.nan), "poses_bounds.npy", "finite numbers"),
    "pose not a rotation": (pose_entry(3, 0, 1.1), "poses_bounds.npy", "another matrix in row 3"),
    "pose mirrored": (pose_entry(2, 0, -1), "poses_bounds.npy", "another matrix in row 2"),
    "focal zero": (without_fx(pose_entry(0, 14, 0)), "poses_bounds.npy", "focal length > 0"),
    "description broken": (lambda f: (f / "sequence.json").write_text("{"), "sequence.json", "a JSON object"),
    "description a list": (lambda f: (f / "sequence.json").write_text("[1]"), "sequence.json", "got list"),
    "description fx": (lambda f: describe(f, fx="586"), "sequence.json", "fx to be a number in [1e-06"),
    "description scale": (lambda f: describe(f, depth_scale=0), "sequence.json", "depth_scale to be a number in ["),
    "description unit": (lambda f: describe(f, depth_unit="m"), "sequence.json", "depth_unit mm, got 'm'"),
    "description polarity": (lambda f: describe(f, mask_tool_value=1), "sequence.json", "mask_tool_value 255 or 0"),
    "description size": (lambda f: describe(f, width=640), "sequence.json", "size 48x40, got 640x40"),
}
ON_VALIDATE = {
    "image unreadable": (cut_short, "images/000004.png", "cannot be decoded"),
    "image is a folder": (a_folder("images/000004.png"), "images/000004.png", "expected a readable file"),
    "image of other size": (replaced("images/000003.png", np.zeros((41, 48, 3), np.uint8)), "000003.png", "48x41"),
    "image 16 bit": (replaced("images/000003.png", np.zeros((*SIZE, 3), np.uint16)), "images/000003.png", "16-bit"),
    "image gray": (replaced("images/000003.png", np.zeros(SIZE, np.uint8)), "images/000003.png", "1 channel"),
    "mask of other size": (replaced("masks/000003.png", np.zeros((8, 9), np.uint8)), "masks/000003.png", "got 9x8"),
    "mask of 0 and 1": (
        replaced("masks/000003.png", np.eye(*SIZE, dtype=np.uint8)),
        "masks/000003.png",
        "got 1. Fix: Multiply",
    ),
    "mask smoothed": (
        replaced("masks/000003.png", np.arange(1920, dtype=np.uint8).reshape(SIZE)),
        "masks/000003.png",
        "expected mask values 0 and 255, got 1, 2, 3, 4 and more. Fix: Threshold",
    ),
    "mask 16 bit": (replaced("masks/000003.png", np.zeros(SIZE, np.uint16)), "masks/000003.png", "an 8-bit mask"),
    "mask in color": (
        replaced("masks/000003.png", np.tile(np.array([0, 255, 0], np.uint8), (*SIZE, 1))),
        "masks/000003.png",
        "one channel",
    ),
    "masks inverted": (replaced_in_all("masks", np.full(SIZE, 255, np.uint8)), "masks", "polarity may be inverted"),
    "depth of other size": (replaced("depth/000003.png", np.zeros((8, 9), np.uint16)), "depth/000003.png", "9x8"),
    "depth in color": (
        replaced("depth/000003.png", np.tile(np.array([9, 255, 0], np.uint8), (*SIZE, 1))),
        "depth/000003.png",
        "one channel",
    ),
    "depth zero": (replaced_in_all("depth", np.zeros(SIZE, np.uint16)), "depth", "got 0 everywhere"),
    "depth on the tool only": (
        replaced_in_all("depth", np.pad(np.ones((1, 1), np.uint16), ((20, 19), (47, 0)))),
        "depth",
        "depth on tissue",
    ),
}


@pytest.mark.parametrize("case", AT_LOAD | ON_VALIDATE)
def test_damage_is_one_line(tiny_sequence, case, capfd):
    damage, named, words = (AT_LOAD | ON_VALIDATE)[case]
    assert_damage_is_rejected(tiny_sequence, damage, named, words)
    if case in AT_LOAD:
        with pytest.raises(InputError):
            load_sequence(tiny_sequence)
    assert capfd.readouterr().err == ""  # the message is all that the user sees


def test_float_tiff_depth_under_png_name_is_rejected(tiny_sequence):
    path = tiny_sequence / "depth/000003.png"
    write(path.with_suffix(".tiff"), np.ones(SIZE, np.float32))
    path.with_suffix(".tiff").rename(path)
    with pytest.raises(InputError, match="16-bit depth image, got float, 1 channel"):
        load_sequence(tiny_sequence).frame(3)
