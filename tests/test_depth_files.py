"""Depth files of every kind read to the same millimeters; bad ones are named in one line."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence, read_depth_file

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
    "int16.npy": lambda p: np.save(p, UNITS.astype(np.int16)),
    "int32.npy": lambda p: np.save(p, UNITS.astype(np.int32)),
    "int64.npy": lambda p: np.save(p, UNITS.astype(np.int64)),
    "uint32.npy": lambda p: np.save(p, UNITS.astype(np.uint32)),
    "axis in front.npy": lambda p: np.save(p, UNITS[None]),
    "batch and channel.npy": lambda p: np.save(p, UNITS[None, None]),
    "axes around.npz": lambda p: np.savez(p, UNITS[None, ..., None]),
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
    "three.npy": (lambda p: np.save(p, np.ones((2, 2, 3))), "(H, W), got shape (2, 2, 3)"),
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


def hole(kind, filling, tissue=70):
    """(32, 40) of tissue with a slope, and a corner that is filled."""
    depth = np.round(tissue + np.arange(40) / 4 + np.zeros((32, 1))).astype(kind)
    depth[:9, :9] = filling
    return depth


FILLED = {
    "16-bit.png": hole(np.uint16, 65535, 700),
    "10000.png": hole(np.uint16, 10000, 700),
    "8-bit.png": hole(np.uint8, 255),
    "saturated.png": hole(np.uint16, 65535, 64000),  # near the end of the range: no gap, but not measured
    "int16.npy": hole(np.int16, 32767),
    "minus one.npy": hole(np.int16, -1),
    "int32.npy": hole(np.int32, 2**31 - 1),
    "million.npy": hole(np.float32, 1e6),
    "largest.npy": hole(np.float64, np.finfo(np.float64).max),
    "infinite.npy": hole(np.float32, np.inf),
    "float.tiff": hole(np.float32, 1000),
    # Less than 1.5 times as far as the tissue, 70 to 80:
    "8-bit near.png": hole(np.uint8, 91),
    "10-bit.png": hole(np.uint16, 1023, 800),
    "12-bit.png": hole(np.uint16, 4095, 2800),
    "14-bit.npy": hole(np.int32, 16383, 15000),
    "last but one.png": hole(np.uint16, 65534, 58000),
    "float near.npy": hole(np.float32, 100.0),
}


@pytest.mark.parametrize("name", FILLED)
def test_a_number_that_stands_for_missing_is_missing(tmp_path, name):
    stored = FILLED[name]
    np.save(tmp_path / name, stored) if name.endswith("npy") else cv2.imwrite(str(tmp_path / name), stored)
    depth = read_depth_file(tmp_path / name, 0.1)
    assert not depth[:9, :9].any()
    rest = np.ones(stored.shape, bool)
    rest[:9, :9] = False
    np.testing.assert_allclose(depth[rest], stored[rest] * 0.1, rtol=1e-6)


def test_two_fillings_and_single_errors_are_missing(tmp_path):
    stored = hole(np.float32, 1e6)
    stored[20:23, 20:23] = 5000
    stored[30, 30] = 3000
    np.save(tmp_path / "a.npy", stored)
    assert (read_depth_file(tmp_path / "a.npy") == 0).sum() == 81 + 9 + 1


@pytest.mark.parametrize(
    "stored",
    [
        np.full((8, 8), 255, np.uint8),  # a wall
        np.tile(np.arange(10, 255, 5, dtype=np.uint8), (9, 1)),  # a deep view, 25 times as far at its end
        np.tile(np.array([60, 62, 85], np.uint16), (9, 3)),
        np.minimum(hole(np.uint16, 740, 700), 706),  # clipped: its end is flat, without an edge
        np.where(np.arange(40) < 18, hole(np.uint8, 70, 40), 95).astype(np.uint8),  # a wall behind a tool
    ],
)
def test_measured_depth_is_kept(tmp_path, stored):
    np.save(tmp_path / "a.npy", stored)
    np.testing.assert_array_equal(read_depth_file(tmp_path / "a.npy"), stored)


def test_the_farthest_pixel_of_relative_depth_is_kept(tmp_path):
    stored = np.linspace(3000, 65535, 64).astype(np.uint16).reshape(8, 8)
    np.save(tmp_path / "a.npy", stored)
    assert read_depth_file(tmp_path / "a.npy", relative=True)[-1, -1] == 65535
    assert read_depth_file(tmp_path / "a.npy")[-1, -1] == 0


def images(folder, count=12):
    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    for i in range(count):
        shade = np.linspace(220, 90, 64)[None, :, None] * np.ones((48, 1, 3)) + rng.integers(-5, 5, (48, 64, 3))
        assert cv2.imwrite(str(folder / f"images/{i}.png"), shade.astype(np.uint8))


def depth_mm(i):
    """(48, 64) 60 to 76 mm."""
    return (60 + np.arange(64) / 4 + i / 10 + np.zeros((48, 1))).astype(np.float32)


def prepare(folder, capsys, *words):
    quick = ("--masks", "none", "--border", "keep", "--layout", "mono")
    quick += () if "--poses" in words else ("--poses", "still")
    assert main(["prepare", str(folder / "images"), str(folder / "out"), *quick, *words]) == 0
    return capsys.readouterr().out


def checked(folder, capsys):
    assert main(["check", str(folder)]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(("filling", "unit"), [(65535, 0.1), (1e6, 1.0), (1023, 0.1), (98.0, 1.0)])
def test_prepare_leaves_holes_empty_and_says_so(tmp_path, capsys, filling, unit):
    images(tmp_path)
    (tmp_path / "depth").mkdir()
    for i in range(12):
        depth = depth_mm(i) / unit
        depth[5:20, 5:25] = filling
        if unit < 1:
            cv2.imwrite(str(tmp_path / f"depth/{i}.png"), np.round(depth).astype(np.uint16))
        else:
            np.save(tmp_path / f"depth/{i}.npy", depth)
    said = prepare(tmp_path, capsys, "--depth", str(tmp_path / "depth"), "--depth-unit-mm", str(unit))
    assert f"note: depth: numbers from {filling:g} on count as missing, 9.8% of it: they are far above the rest" in said
    for i in (0, 11):
        stored = cv2.imread(str(tmp_path / f"out/depth/{i:06d}.png"), cv2.IMREAD_UNCHANGED) * 0.01
        assert not stored[5:20, 5:25].any()
        stored[5:20, 5:25] = depth_mm(i)[5:20, 5:25]
        assert np.abs(stored - depth_mm(i)).max() < 0.06
    assert "depth-far" not in checked(tmp_path / "out", capsys)


def test_check_warns_of_tissue_out_of_reach(tmp_path, capsys):
    images(tmp_path)
    (tmp_path / "depth").mkdir()
    for i in range(12):
        depth = depth_mm(i)
        if i in (3, 4):
            depth[5:20, 5:25] = np.linspace(300, 330, 20)
        np.save(tmp_path / f"depth/{i}.npy", depth)
    (tmp_path / "sequence.json").write_text('{"depth_scale": 1.0}')
    said = checked(tmp_path, capsys)
    assert "warning: depth-far: depth beyond 250 mm on 9.8% of the tissue with depth in frames 3-4" in said


def test_depth_of_whole_mm_in_16_bits_is_not_called_8_bits(tmp_path, capsys):
    images(tmp_path)
    for name, kind in (("fine", np.uint16), ("coarse", np.uint8)):
        (tmp_path / name).mkdir()
        for i in range(12):
            cv2.imwrite(str(tmp_path / f"{name}/{i}.png"), np.round(depth_mm(i)).astype(kind))
        said = prepare(tmp_path, capsys, "--depth", str(tmp_path / name), "--depth-unit-mm", "1")
        assert ("8-bit files" in said) == (name == "coarse")
        (tmp_path / "out").rename(tmp_path / f"{name}_out")


def test_where_no_tools_are_found_the_brush_is_named_first(tmp_path, capsys):
    images(tmp_path)
    said = prepare(tmp_path, capsys, "--depth", "none", "--masks", "auto")
    assert "masks: no tools found." in said
    out = tmp_path / "out"
    brush = f"no tools were found; if there are any, paint them: `endoprior view {out}`\nnext: `endoprior check {out}`"
    assert brush in said
    out.rename(tmp_path / "before")
    assert "paint them" not in prepare(tmp_path, capsys, "--depth", "none")


def test_a_folder_prepared_without_depth_opens_and_check_says_how_to_add_it(tmp_path, capsys):
    images(tmp_path)
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3] = np.arange(12)
    np.save(tmp_path / "poses.npy", poses)
    said = prepare(tmp_path, capsys, "--depth", "none", "--poses", str(tmp_path / "poses.npy"))
    assert f"next: `endoprior check {tmp_path / 'out'}`" in said
    sequence = load_sequence(tmp_path / "out")
    assert len(sequence) == 12 and sequence.camera(5).world_to_camera[0, 3] == -5
    assert sequence.camera(0).fx == pytest.approx(32 / np.tan(np.radians(35)))
    said = checked(tmp_path / "out", capsys)
    assert "error: no-depth-frames: no frame has depth. Fix: run `prepare` without `--depth`" in said


@pytest.mark.slow
def test_the_depth_of_the_real_clip_is_kept(real_clip):
    for path in sorted((real_clip / "depth").iterdir())[::15]:
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # clipped to 129.37 mm
        np.testing.assert_array_equal(read_depth_file(path) > 0, stored > 0)
