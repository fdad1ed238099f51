"""Images as cameras and phones write them: turned by EXIF, with data after the end, with a small picture inside."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.images import decode_image, read_color, read_header
from endoprior.prepare.source import open_source

RNG = np.random.default_rng(0)
PIXELS = cv2.resize(RNG.integers(0, 255, (6, 8, 3), dtype=np.uint8), (80, 48), interpolation=cv2.INTER_NEAREST)


def encoded(kind, turn=1, pixels=PIXELS, **options):
    """Bytes of an image whose EXIF says how it lies."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[274] = turn
    how = {"JPEG": {"quality": 95, "exif": exif}, "PNG": {"exif": exif}, "WEBP": {"lossless": True, "exif": exif}}
    Image.fromarray(pixels).save(file, kind, **how.get(kind, {"tiffinfo": {274: turn}}), **options)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("turn", range(1, 9))
def test_images_are_read_as_they_are_shown(tmp_path, kind, turn):
    data = encoded(kind, turn)
    path = tmp_path / f"a.{kind.lower()}"
    path.write_bytes(data)
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB")).astype(int)
    assert read_header(data) == (*shown.shape[1::-1], turn)
    for found in (read_color(path, shown.shape[1::-1]), decode_image(path, None, cv2.IMREAD_COLOR)[..., ::-1]):
        assert found.shape == shown.shape and np.abs(found.astype(int) - shown).mean() < 3


def test_a_folder_and_prepare_show_the_same(tmp_path):
    (tmp_path / "images").mkdir()
    for i in range(3):
        (tmp_path / f"images/{i}.jpg").write_bytes(encoded("JPEG", 6))
    source = open_source(tmp_path / "images")
    assert (source.width, source.height) == (48, 80)
    np.testing.assert_array_equal(load_sequence(tmp_path).frame(1).rgb_u8, next(iter(source)).rgb_u8)


def jpegs():
    """JPEG files in several kinds, one with a small picture in its EXIF."""
    small = encoded("JPEG", pixels=PIXELS[::8, ::8])
    yield cv2.imencode(".jpg", PIXELS, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    yield cv2.imencode(".jpg", PIXELS, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1].tobytes()
    plain = cv2.imencode(".jpg", PIXELS)[1].tobytes()
    body = b"Exif\0\0" + small
    yield plain[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + plain[2:]


@pytest.mark.parametrize("data", list(jpegs()), ids=["progressive", "restarts", "small picture"])
def test_what_follows_the_end_of_a_jpeg_does_not_count(tmp_path, data, capfd):
    for tail in (b"", b"\0" * 5000, b"trailer" * 3000, encoded("JPEG", pixels=PIXELS[:8])[:-300]):
        assert read_header(data + tail) == (80, 48, 1)
        (tmp_path / "a.jpg").write_bytes(data + tail)
        np.testing.assert_array_equal(
            read_color(tmp_path / "a.jpg"), cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1]
        )
    for length in range(2, len(data), 41):
        assert read_header(data[:length]) is None
    (tmp_path / "a.jpg").write_bytes(data[:-90])
    with pytest.raises(InputError, match="cannot be decoded"):
        read_color(tmp_path / "a.jpg")
    assert capfd.readouterr().err == ""


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")  # as everywhere but in tests
def test_damaged_exif_says_nothing():
    data = bytearray(encoded("JPEG", 6))
    at = data.index(b"Exif\0\0") + 6
    for position in range(at, at + 20):
        broken = bytes(data[:position]) + bytes([data[position] ^ 255]) + bytes(data[position + 1 :])
        assert read_header(broken) in ((80, 48, 1), (48, 80, 6))


def test_exif_behind_the_pixels_of_a_png(tmp_path):
    data = encoded("PNG", 6)
    start = data.index(b"eXIf") - 4
    stop = start + 12 + int.from_bytes(data[start : start + 4], "big")
    moved = data[:start] + data[stop:-12] + data[start:stop] + data[-12:]
    assert read_header(moved) == read_header(data) == (48, 80, 6)
