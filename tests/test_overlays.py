"""Detection of burned-in text: static text in a changing image, and nothing else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.data.images import read_color
from endoprior.footage.overlays import find_static_overlays

HEIGHT, WIDTH, COUNT = 160, 240, 10


def moving(seed=0):
    """Images of high-contrast blobs that slide by several px from one to the next."""
    rng = np.random.default_rng(seed)
    blobs = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT + 200, WIDTH + 200)), (0, 0), 3)
    levels = np.clip(120 + 50 * blobs / blobs.std(), 0, 255)
    frames = []
    for k in range(COUNT):
        part = levels[9 * k : 9 * k + HEIGHT, 11 * k : 11 * k + WIDTH]
        color = part[..., None] * [1.0, 0.6, 0.55] + rng.normal(0, 2, (HEIGHT, WIDTH, 3))
        frames.append(np.clip(color, 0, 255).astype(np.uint8))
    return frames


def written(frames, text="ROOM12", at=(20, 140), box=False):
    """The frames with white writing."""
    out = [frame.copy() for frame in frames]
    for frame in out:
        if box:
            cv2.rectangle(frame, (at[0] - 4, at[1] - 18), (at[0] + 90, at[1] + 5), (0, 0, 0), -1)
        cv2.putText(frame, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2, cv2.LINE_AA)
    return out


def ink(frames, marked):
    """(left, top, right, bottom) of all pixels that writing changed."""
    rows, columns = np.nonzero(np.any(np.stack(frames) != np.stack(marked), axis=(0, 3)))
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


@pytest.mark.parametrize("box", [False, True])
def test_text_is_detected_at_its_position(box):
    frames = moving()
    marked = written(frames, box=box)
    left, top, right, bottom = ink(frames, written(frames))
    (found,) = find_static_overlays(marked)
    x, y, width, height = found
    assert x <= left and y <= top and x + width >= right and y + height >= bottom
    assert width * height < 4 * (right - left) * (bottom - top)


def test_a_clock_is_found_though_its_digits_change():
    images = [
        written([frame], f"12:0{i % 5}:{37 * i % 60:02d}", (60, 100), box=True)[0] for i, frame in enumerate(moving())
    ]
    (x, y, width, height), *more = find_static_overlays(images)
    assert x <= 64 and x + width >= 140 and y <= 90 and y + height >= 98 and not more


def test_static_highlights_are_no_label():
    glare = np.zeros((HEIGHT, WIDTH), np.float32)
    for x, y in ((100, 100), (109, 103), (118, 101), (127, 105)):
        cv2.ellipse(glare, (x, y), (5, 3), 30, 0, 360, 300, -1)
    glare = cv2.GaussianBlur(glare, (0, 0), 1.2)[..., None]
    shown = np.where(glare > 8, 90 + 0.6 * glare, 0)
    images = [np.clip(np.where(glare > 8, shown, frame), 0, 255).astype(np.uint8) for frame in moving()]
    assert find_static_overlays(images) == []


def test_two_labels_are_sorted_from_top_to_bottom():
    first, second = find_static_overlays(written(written(moving()), "CAM2", (140, 30)))
    assert first[1] < second[1] and first[0] > second[0]


def test_no_text_and_a_static_scene_give_nothing():
    marked, noise = written(moving())[0], np.random.default_rng(3)
    still = [np.clip(marked + noise.normal(0, 2, marked.shape), 0, 255).astype(np.uint8) for _ in range(COUNT)]
    assert find_static_overlays(moving()) == find_static_overlays(still) == []


def test_borders_are_not_text():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    round_border = (x - 120) ** 2 + (y - 80) ** 2 < 75**2
    bars = (x >= 20) & (x < 220) & (y >= 12) & (y < 150)
    for inside in (round_border, bars):
        assert find_static_overlays([np.where(inside[..., None], p, 0).astype(np.uint8) for p in moving()]) == []
    divider = (x >= 100) & (x < 108)
    assert find_static_overlays([np.where(divider[..., None], 255, p).astype(np.uint8) for p in moving()]) == []


def test_too_few_images_give_nothing():
    marked = written(moving())
    assert find_static_overlays(marked[:4]) == [] and find_static_overlays([]) == []
    with pytest.raises(ValueError, match="image must have shape"):
        find_static_overlays([*marked[:5], marked[5][:-1]])


def test_real_clip(real_clip):
    images = [read_color(real_clip / "images" / f"{i:06d}.png") for i in range(0, 90, 6)]
    (found,) = find_static_overlays(images)  # the word "Left" in a label of 110x42 px at the corner
    x, y, width, height = found
    assert x < 20 and y < 10 and 50 < width < 120 and 25 < height < 60
