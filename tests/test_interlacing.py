"""Interlaced images are told from progressive ones: by the times of their rows, whatever moves and however dithered."""

from itertools import islice

import cv2
import numpy as np
import pytest
from conftest import REAL_DATA
from PIL import Image
from video_files import encode, smooth

from endoprior.data.images import read_color
from endoprior.footage.interlacing import Interlacing
from endoprior.prepare.config import PrepareConfig
from endoprior.prepare.source import open_source
from endoprior.prepare.video_clip import Clip

BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16


def fields(count, step, height=96, width=128):
    """Images (H, W, 3) of a texture that moves by `step` px to the right and half as much down."""
    rng = np.random.default_rng(0)
    large = cv2.GaussianBlur(rng.random((height + 60, width + 100, 3)).astype(np.float32), (0, 0), 1.5)
    large = (large - large.min()) / np.ptp(large) * 255
    moves = (np.array([[1, 0, i * step], [0, 1, i * step / 2]], np.float32) for i in range(count))
    return [cv2.warpAffine(large, move, (width + 100, height + 60))[50:-10, 90:-10].astype(np.uint8) for move in moves]


def woven(images, first=0):
    """Each two images as one: the odd rows are those of the second; with `first` 1 the even ones."""
    both = [image.copy() for image in images[::2]]
    for image, second in zip(both, images[1::2], strict=False):
        image[1 - first :: 2] = second[1 - first :: 2]
    return both


def is_interlaced(images):
    found = Interlacing()
    for image in images:
        found.see(image)
    return found.is_certain


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("step", [0.4, 0.8, 1.8, 4.0])
def test_interlaced_images_are_told_from_progressive_ones(step, first):
    images = fields(20, step)
    assert is_interlaced(woven(images, first)) and not is_interlaced(images)


def test_fields_that_are_unlike_are_interlaced():
    images = smooth(24, step=9)
    assert is_interlaced(woven(images)) and not is_interlaced(images)


def test_some_interlaced_images_of_film_are_enough():
    a = fields(40, 1.5)
    film = []
    for i in range(0, 40, 4):  # 4 images in 5 of video: two of them are woven
        film += [a[i], a[i + 1], *woven([a[i + 1], a[i + 2]]), *woven([a[i + 2], a[i + 3]]), a[i + 3]]
    assert is_interlaced(film)


def checkerboard(image):
    dots = np.indices(image.shape[:2]).sum(0)[..., None] % 2 / 2 + 0.25
    return np.uint8(np.floor(image / 85 + dots) * 85)


def ordered(image):
    matrix = np.tile(BAYER, (image.shape[0] // 4, image.shape[1] // 4))
    return np.uint8(np.clip(np.floor(image / 64 + matrix[..., None]) * 64, 0, 255))


def diffused(image):
    return np.array(Image.fromarray(image).quantize(8).convert("RGB"))


@pytest.mark.parametrize("dither", [checkerboard, ordered, diffused])
@pytest.mark.parametrize("step", [0, 0.7, 3])
def test_dithered_images_are_progressive(dither, step):
    assert not is_interlaced([dither(image) for image in fields(20, step)])


def test_nothing_is_said_without_motion_or_images():
    still, rng = fields(1, 0)[0], np.random.default_rng(0)
    assert not is_interlaced(woven([still] * 20)) and not is_interlaced([])
    assert not is_interlaced([image[:12, :12] for image in woven(fields(20, 2))])
    assert not is_interlaced(list(rng.integers(0, 256, (12, 96, 128, 3), np.uint8)))


@pytest.mark.parametrize("is_flagged", [False, True])
def test_the_note_on_a_video_without_the_flag(tmp_path, is_flagged):
    options = {"crf": "10"} | ({"flags": "+ilme+ildct", "x264-params": "tff=1"} if is_flagged else {})
    video = encode(tmp_path / "a.mp4", woven(fields(24, 0.9)), options=options)
    clip = Clip(video, PrepareConfig(layout="mono"), None)
    list(clip.stereo_frames(clip.selection()))
    assert any("rows alternate" in note for note in clip.notes) != is_flagged


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["broncho_phantom", "colon_boxes", "fetoscopy", "lap_smoke_stapler", "round_shaver", "vocal_folds_hsv"]
)
def test_real_progressive_clips(name):
    clip = REAL_DATA / "wild" / f"{name}.mp4"
    if not clip.is_file():
        pytest.skip(f"real clip not present at {clip}")
    images = [image.rgb_u8 for image in islice(open_source(clip), 96)]
    assert not is_interlaced(images) and is_interlaced(woven(images))


@pytest.mark.slow
def test_the_real_sequence(real_clip):
    images = [read_color(file) for file in sorted((real_clip / "images").iterdir())]
    assert not is_interlaced(images) and is_interlaced(woven(images))
