"""What every reader stands on: kinds of files, sizes by headers alone, arrays and YAML that cannot lie or explode."""

from __future__ import annotations

import dataclasses
import io
import math
import os
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import reading
from endoprior.data.files import in_order
from endoprior.data.images import read_header
from endoprior.data.reading import MAX_NODES, kind_of, load_yaml, read_bytes, read_numpy, read_text
from endoprior.phantom import PhantomConfig
from endoprior.prepare import PrepareConfig
from endoprior.prepare.stereo import StereoConfig
from endoprior_studies.worker import finished

HINT = "Write it again."


@pytest.mark.skipif(os.name == "nt", reason="Windows has no named pipes in folders")
def test_kinds_are_told_apart_without_opening(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "away").symlink_to("nowhere")
    (tmp_path / "link").symlink_to("file")
    os.mkfifo(tmp_path / "pipe")
    kinds = {name: kind_of(tmp_path / name) for name in ("file", "loop", "away", "link", "pipe", "none", "file/x")}
    assert kinds["file"] == kinds["link"] == "a file"
    assert kinds["loop"] == kinds["away"] == kinds["none"] == kinds["file/x"] == "nothing"
    assert kinds["pipe"] == "a device or a pipe" and kind_of(tmp_path) == "a folder"
    for name in ("x" * 5000, "a\0b"):
        with pytest.raises(InputError) as caught:
            kind_of(tmp_path / name)
        assert len(str(caught.value)) < 400 and "\0" not in str(caught.value)


def test_files_too_large_are_rejected_by_their_size_in_mb(tmp_path, monkeypatch):
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate((1 << 30) + 1)
    with pytest.raises(InputError, match="at most 1024 MB, got 1024 MB"):
        read_bytes(tmp_path / "sparse")
    monkeypatch.setattr(reading, "MAX_TEXT_BYTES", 1 << 20)
    (tmp_path / "text").write_bytes(bytes(3 << 20))
    with pytest.raises(InputError, match="at most 1 MB, got 3 MB"):
        read_text(tmp_path / "text", "words", HINT)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".webp"])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (37, 64), (300, 5)])
def test_headers_say_the_size_that_decoding_gives(suffix, width, height):
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    for quality in (90, 101) if suffix == ".webp" else (90,):  # above 100, WebP is lossless and has another header
        flags = [cv2.IMWRITE_WEBP_QUALITY, quality] if suffix == ".webp" else []
        encoded = cv2.imencode(suffix, pixels, flags)[1].tobytes()
        assert read_header(encoded) == (width, height, 1)
        for length in range(0, min(len(encoded), 200), 7):
            assert read_header(encoded[:length]) in (None, (width, height, 1))


def test_progressive_jpegs_float_and_big_tiffs_and_alpha_are_known():
    pixels = np.zeros((20, 30, 3), np.uint8)
    progressive = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    float_tiff = cv2.imencode(".tiff", np.zeros((20, 30), np.float32))[1].tobytes()
    alpha = cv2.imencode(".webp", np.dstack([pixels, pixels[..., 0]]))[1].tobytes()
    assert read_header(progressive) == read_header(float_tiff) == read_header(alpha) == (30, 20, 1)
    fields = [(256, 30), (257, 20)]
    entries = b"".join(struct.pack("<HHQQ", tag, 4, 1, value) for tag, value in fields)
    assert read_header(struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, len(fields)) + entries + bytes(8)) == (30, 20, 1)
    assert read_header(b"GIF89a" + bytes(50)) is None and read_header(b"") is None


def test_one_wrong_bit_of_a_png_is_seen():
    encoded = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (9, 8, 3), dtype=np.uint8))[1].tobytes()
    for at in range(8, len(encoded) - 12):  # the end has no content
        assert read_header(encoded[:at] + bytes([encoded[at] ^ 16]) + encoded[at + 1 :]) is None, at
    assert read_header(encoded[:-8]) is None and read_header(encoded + b"padding") == (8, 9, 1)


@pytest.mark.parametrize("array", [np.arange(6.0).reshape(2, 3), np.array(5), np.asfortranarray(np.eye(3)),
                                   np.zeros((0, 4), np.float32), np.array([True]), np.array(["ab", "c"])])  # fmt: skip
def test_sound_arrays_are_read_as_numpy_reads_them(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "b.npz", one=array, two=array)
    np.savez_compressed(tmp_path / "c.npz", one=array)
    for found in (
        read_numpy(tmp_path / "a.npy", "numbers", HINT),
        read_numpy(tmp_path / "b.npz", "numbers", HINT)["two"],
        read_numpy(tmp_path / "c.npz", "numbers", HINT)["one"],
    ):
        assert found.dtype == array.dtype and np.array_equal(found, array)


def test_an_archive_is_measured_before_it_is_unfolded(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MAX_BYTES", 1 << 20)
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(1 << 18))
    with pytest.raises(InputError, match="1 arrays of 2 MB; at most 1 MB"):
        read_numpy(tmp_path / "a.npz", "numbers", HINT)


def test_an_archive_whose_members_lie_is_rejected(tmp_path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", member)
    with pytest.raises(InputError, match="for 0 bytes"):
        read_numpy(tmp_path / "a.npz", "numbers", HINT)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(5000))
    damaged = bytearray(packed.getvalue())
    damaged[45:55] = b"\xff" * 10
    (tmp_path / "b.npz").write_bytes(damaged)
    with pytest.raises(InputError, match=r"b\.npz: expected numbers"):
        read_numpy(tmp_path / "b.npz", "numbers", HINT)


def test_yaml_counts_what_aliases_stand_for():
    assert load_yaml("a: &a [1, 2]\nb: *a\nc: {<<: {d: 1}, e: 2}") == {"a": [1, 2], "b": [1, 2], "c": {"d": 1, "e": 2}}
    many = ", ".join(["*a"] * 300)
    texts = {
        f"a: &a [{', '.join('1' * 400)}]\nb: [{many}]": f"at most {MAX_NODES}",
        "a: &a [*a]": "itself",
        "[" * 60 + "]" * 60: "nested",
        "a: 1\nb: {c: 1, c: 2}": "'c' twice",
        "!!python/name:os.system ''": "python/name",
    }
    for text, words in texts.items():
        with pytest.raises(yaml.YAMLError, match=words):
            load_yaml(text)


@pytest.mark.parametrize("cls", [DataConfig, PrepareConfig, StereoConfig, PhantomConfig])
def test_no_number_of_a_config_may_be_nan_or_without_bounds(cls):
    for field in dataclasses.fields(cls):
        if field.type not in ("int", "float", "float | None"):
            continue
        unbounded = (cls, field.name) == (PrepareConfig, "end")  # to the end of the clip
        wrong = [-math.inf, 10**30] if field.type == "int" else [math.nan, -math.inf]
        for value in [*wrong, *([] if unbounded else [math.inf])]:
            with pytest.raises(ValueError, match=rf"\b{field.name}\b"):
                cls(**{field.name: value})


@pytest.mark.parametrize("name", ["cell.json", "metrics.json"])
@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"[" * 100_000, bytes(range(256))])
def test_a_benchmark_cell_that_cannot_be_read_is_not_finished(tmp_path, name, content):
    (tmp_path / "cell.json").write_text('{"key": "k", "seconds": 1.0}')
    (tmp_path / "metrics.json").write_text('{"scores": {"psnr": 30.0}}')
    assert finished(tmp_path, "k") and not finished(tmp_path, "other")
    (tmp_path / name).write_bytes(content)
    assert not finished(tmp_path, "k")


def test_files_are_ordered_whatever_their_digits_are():
    names = ["a10.png", "a2.png", "a²1.png", "a٣.png", "10.png", "²"]
    ordered = [path.name for path in in_order(map(Path, names))]
    assert ordered.index("a2.png") < ordered.index("a10.png") and len(ordered) == len(names)
