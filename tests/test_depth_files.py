"""Depth files of every kind read to the same millimeters; bad ones are named in one line."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data import read_depth_file

UNITS = np.array([[0, 1, 2], [250, 7, 0]], np.float32)
MM = UNITS * np.float32(0.5)


def save_exr(path, **channels):
    exr = pytest.importorskip("OpenEXR", reason="EXR files need the OpenEXR package")
    exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels).write(str(path))


WRITERS = {
    "8-bit.png": lambda p: cv2.imwrite(str(p), UNITS.astype(np.uint8)),
    "16-bit.png": lambda p: cv2.imwrite(str(p), UNITS.astype(np.uint16)),
    "equal channels.png": lambda p: cv2.imwrite(str(p), np.repeat(UNITS.astype(np.uint16)[..., None], 3, 2)),
    "float.tiff": lambda p: cv2.imwrite(str(p), UNITS),
    "16-bit.tif": lambda p: cv2.imwrite(str(p), UNITS.astype(np.uint16)),
    "float64.npy": lambda p: np.save(p, UNITS.astype(np.float64)),
    "half.npy": lambda p: np.save(p, UNITS.astype(np.float16)),
    "channel.npy": lambda p: np.save(p, UNITS[..., None]),
    "one.npz": lambda p: np.savez(p, depth=UNITS),
    "z.exr": lambda p: save_exr(p, Z=UNITS, R=np.ones_like(UNITS)),
    "y.exr": lambda p: save_exr(p, Y=UNITS),
    "equal.EXR": lambda p: save_exr(p, RGB=np.repeat(UNITS[..., None], 3, 2)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_kind_gives_the_same_millimeters(tmp_path, name):
    WRITERS[name](tmp_path / name)
    depth = read_depth_file(tmp_path / name, 0.5, (3, 2))
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, MM)  # halves of small integers are exact


@pytest.mark.parametrize("name", ["a.npy", "a.tiff", "a.exr"])
def test_what_is_not_a_depth_is_missing(tmp_path, name):
    stored = np.array([[np.nan, np.inf, -np.inf], [-3, 0, 4]], np.float32)
    writers = {"a.npy": lambda p: np.save(p, stored), "a.tiff": lambda p: cv2.imwrite(str(p), stored)}
    writers.get(name, lambda p: save_exr(p, Z=stored))(tmp_path / name)
    np.testing.assert_array_equal(read_depth_file(tmp_path / name), [[0, 0, 0], [0, 0, 4]])


def test_a_number_beyond_float32_is_missing(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1e300, 2.0]]))
    np.testing.assert_array_equal(read_depth_file(tmp_path / "a.npy"), [[0, 2]])


BAD = {
    "missing.npy": (lambda p: None, "No such file"),
    "missing.tiff": (lambda p: None, "No such file"),
    "missing.exr": (lambda p: None, "an EXR image"),
    "garbage.npy": (lambda p: p.write_bytes(b"x"), "a NumPy file"),
    "garbage.npz": (lambda p: p.write_bytes(b"PK\x03\x04x"), "a NumPy file"),
    "garbage.tiff": (lambda p: p.write_bytes(b"II*\0x"), "cannot be decoded"),
    "garbage.exr": (lambda p: p.write_bytes(b"x"), "an EXR image"),
    "pickle.npy": (lambda p: np.save(p, np.array([None])), "a NumPy file"),
    "two.npz": (lambda p: np.savez(p, a=UNITS, b=UNITS), "one array, got 2"),
    "none.npz": (lambda p: np.savez(p), "one array, got 0"),
    "vector.npy": (lambda p: np.save(p, np.ones(3)), "(H, W), got shape (3,)"),
    "integers.npy": (lambda p: np.save(p, np.ones((2, 3), np.int64)), "64-bit"),
    "booleans.npy": (lambda p: np.save(p, np.ones((2, 3), bool)), "got bool"),
    "size.npy": (lambda p: np.save(p, np.ones((3, 2))), "3x2 px like the first image, got 2x3"),
    "size.tiff": (lambda p: cv2.imwrite(str(p), np.ones((3, 2), np.float32)), "3x2 px like the first image, got 2x3"),
    "colors.exr": (lambda p: save_exr(p, R=UNITS, G=UNITS + 1), "one channel, or one called Z, got "),
    "color.tiff": (lambda p: cv2.imwrite(str(p), np.arange(18, dtype=np.uint8).reshape(2, 3, 3)), "one channel"),
    "depth.jpg": (lambda p: p.write_bytes(b""), "one of .png"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_named(tmp_path, name, capfd):
    write, words = BAD[name]
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR", reason="EXR files need the OpenEXR package")
    write(tmp_path / name)
    with pytest.raises(InputError) as caught:
        read_depth_file(tmp_path / name, 1.0, (3, 2))
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / name}: expected ") and words in message
    assert "\n" not in message and message.endswith(".")


def test_exr_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "a.exr").write_bytes(b"x")
    with pytest.raises(InputError, match=r"Fix: `pip install -c constraints\.txt OpenEXR`"):
        read_depth_file(tmp_path / "a.exr")
