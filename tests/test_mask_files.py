"""Mask files in all formats, their polarity, and error messages that name file, problem and fix."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image

from endoprior.core.checks import InputError
from endoprior.data.mask_files import read_user_mask, tool_polarity

SIZE = (64, 48)
TRUE = np.zeros((48, 64), bool)
TRUE[10:40, 20:50] = True
INNER, OUTER = (change(TRUE.astype(np.uint8), np.ones((5, 5))) > 0 for change in (cv2.erode, cv2.dilate))
U8 = TRUE.astype(np.uint8)
LABELS = U8 + U8 * (np.arange(64) > 30)  # two parts of a tool, 1 and 2


def save(path, values):
    """Write an image (RGB or RGBA order for colors) or an array."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez_compressed(path, mask=values)
    else:
        order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}
        stored = values[..., order[values.shape[2]]] if values.ndim == 3 else values
        assert cv2.imwrite(str(path), stored)
    return path


def colored(background=0):
    """(48, 64, 3) two tool parts in two colors."""
    palette = np.array([[background] * 3, [0, 90, 0], [200, 0, 30]], np.uint8)
    return palette[LABELS]


EXACT = {
    "0 and 255.png": 255 * U8,
    "0 and 1.png": U8,
    "labels.png": LABELS,
    "spread labels.png": 50 * LABELS,
    "16 bit.png": 65535 * TRUE.astype(np.uint16),
    "16 bit labels.tif": LABELS.astype(np.uint16),
    "16 bit spread labels.png": 300 * LABELS.astype(np.uint16),
    "gray as color.png": np.dstack([255 * U8] * 3),
    "colors.png": colored(),
    "colors.bmp": colored(),
    "alpha.png": np.dstack([np.full((48, 64, 3), 200, np.uint8), 255 * U8]),
    "colors, opaque.png": np.dstack([colored(), np.full((48, 64), 255, np.uint8)]),
    "bool.npy": TRUE,
    "sam.npy": np.stack([LABELS == 1, LABELS == 2, LABELS == 7]),
    "sam 2.npy": np.stack([LABELS == 1, LABELS == 2])[:, None],
    "sam 2, one object.npy": TRUE[None, None],
    "one channel.npy": TRUE[..., None],
    "labels.npy": LABELS.astype(np.int64),
    "probability.npy": np.where(TRUE, 0.8, 0.3).astype(np.float32),
    "logits.npy": np.where(TRUE, 2.0, -3.0),
    "zero and 255.npy": 255.0 * TRUE,
    "bool.npz": TRUE,
}


@pytest.mark.parametrize("name", EXACT)
def test_every_format_gives_the_same_mask(tmp_path, name):
    assert (read_user_mask(save(tmp_path / name, EXACT[name]), SIZE) == TRUE).all()


def test_a_palette_image_as_annotation_programs_write_it(tmp_path):
    image = Image.fromarray(LABELS)
    image.putpalette([0, 0, 0, 51, 221, 255, 250, 50, 83])  # background, and two labels
    assert image.mode == "P"
    image.save(tmp_path / "frame_000000.png")
    assert (read_user_mask(tmp_path / "frame_000000.png", SIZE) == TRUE).all()


@pytest.mark.parametrize("name", ["smooth.png", "gray.jpg", "gray as color.jpg", "colors.jpg"])
def test_smoothed_and_compressed_masks_keep_their_outline(tmp_path, name):
    smooth = cv2.GaussianBlur(255 * U8, (0, 0), 1)
    values = {
        "smooth.png": smooth,
        "gray.jpg": 255 * U8,
        "gray as color.jpg": np.dstack([smooth] * 3),
        "colors.jpg": np.where(TRUE[..., None], (220, 30, 30), 0).astype(np.uint8),
    }
    found = read_user_mask(save(tmp_path / name, values[name]), SIZE)
    assert found[INNER].all() and not found[~OUTER].any()


@pytest.mark.parametrize("name", ["empty.png", "empty.jpg", "empty.npy"])
def test_empty_masks_are_empty(tmp_path, name):
    assert not read_user_mask(save(tmp_path / name, np.zeros((48, 64), np.uint8)), SIZE).any()
    if name != "empty.jpg":  # inverted and empty
        assert read_user_mask(save(tmp_path / name, np.full((48, 64), 255, np.uint8)), SIZE).all()


def unusable(folder):
    """{what is wrong: file}"""
    holed = np.where(TRUE, 1.0, 0.0)
    holed[3, 4] = np.nan
    photo = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    (folder / "broken.npy").write_bytes(b"nonsense")
    np.savez(folder / "two.npz", a=TRUE, b=TRUE)
    np.save(folder / "objects.npy", np.array([{}, 1], dtype=object))
    return {
        "got 48x64": save(folder / "size.png", 255 * U8.T),
        "got 1 NaN or infinite": save(folder / "nan.npy", holed),
        "cannot be decoded": folder / "broken.png",
        "a NumPy file": folder / "broken.npy",
        "pickled objects": folder / "objects.npy",
        "one array": folder / "two.npz",
        "many colors": save(folder / "photo.png", photo),
        "No such file": folder / "absent.png",
        "numbers of shape": save(folder / "flat.npy", np.zeros(5)),
        "values up to 7.5": save(folder / "odd.npy", 7.5 * TRUE),
    }


def test_error_messages_name_the_file_on_one_line(tmp_path):
    for finding, path in unusable(tmp_path).items():
        with pytest.raises(InputError) as error:
            read_user_mask(path, SIZE)
        text = str(error.value)
        assert str(path) in text and finding in text and "expected" in text and "\n" not in text


def test_polarity_by_option_detection_or_convention():
    image = np.where(TRUE[..., None], (120, 120, 120), (190, 90, 85)).astype(np.uint8)
    assert tool_polarity("low", [TRUE], [image]).tool_is_high is False
    assert "--mask-tool-value" in tool_polarity("high", [~TRUE], [image]).reason
    assert tool_polarity("auto", [TRUE], [image]).tool_is_high
    found = tool_polarity("auto", [~TRUE], [image])
    assert not found.tool_is_high and found.reason.startswith("low values mark tools")
    unclear = tool_polarity("auto", [np.ones_like(TRUE)], [image])
    assert unclear.tool_is_high and "convention" in unclear.reason
