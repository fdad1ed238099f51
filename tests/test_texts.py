"""Burnt-in text: found by the network, confirmed over several images, followed where it moves, and nothing else."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data.images import read_color
from endoprior.footage import text_network
from endoprior.footage.text_network import TextBox, TextDetector, box_around
from endoprior.footage.texts import confirm, follow, rectangle, text_mask

HEIGHT, WIDTH, COUNT = 192, 256, 8
WHITE, YELLOW = (255, 255, 255), (250, 250, 40)
PAGE = Path(__file__).parent.parent / "docs" / "text_network.md"


@pytest.fixture(scope="module")
def find():
    return TextDetector().find


def moving_tissue(seed=0):
    """Images of soft blobs that slide by several px from one to the next."""
    rng = np.random.default_rng(seed)
    blobs = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT + 200, WIDTH + 200)), (0, 0), 8)
    levels = np.clip(120 + 30 * blobs / blobs.std(), 0, 255)
    frames = []
    for k in range(COUNT):
        part = levels[9 * k : 9 * k + HEIGHT, 11 * k : 11 * k + WIDTH]
        color = part[..., None] * [1.0, 0.5, 0.45] + rng.normal(0, 2, (HEIGHT, WIDTH, 3))
        frames.append(np.clip(color, 0, 255).astype(np.uint8))
    return frames


def written(frame, text="SMITH, JOHN", at=(60, 140), size=0.45, color=WHITE, degrees=0.0):
    """The frame with writing, whose capitals are `22 * size` px high, and (H, W) where its ink is."""
    ink = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.putText(ink, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, 255, 1, cv2.LINE_AA)
    turn = cv2.getRotationMatrix2D(at, -degrees, 1)
    ink = cv2.warpAffine(ink, turn, (WIDTH, HEIGHT))
    share = ink[..., None] / 255
    return (frame * (1 - share) + np.array(color) * share).astype(np.uint8), ink > 60


def at(x, y, length=80.0, height=16.0, degrees=0.0, score=0.95):
    return TextBox(score, x, y, length, height, degrees)


def test_the_weights_are_those_of_the_page(tmp_path, monkeypatch):
    assert hashlib.sha256(text_network.FILE.read_bytes()).hexdigest() == text_network.SHA256
    assert text_network.SHA256 in PAGE.read_text(encoding="utf-8")
    changed = tmp_path / "other.onnx"
    monkeypatch.setattr(text_network, "FILE", changed)
    with pytest.raises(InputError, match="weights of the text detector"):
        TextDetector()
    changed.write_bytes(b"other")
    with pytest.raises(InputError, match="SHA-256"):
        TextDetector()


@pytest.mark.parametrize("degrees", [0, 20, -75])
def test_a_box_of_points_has_their_center_sides_and_angle(degrees):
    turn = np.radians(degrees)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    points = np.array([[-20, -5], [20, -5], [20, 5], [-20, 5]]) @ axes + [50, 40]
    box = box_around(points.astype(np.float32), 0.9, margin=2)
    assert np.allclose([box.x, box.y, box.length, box.height, box.degrees], [50, 40, 44, 14, degrees], atol=1e-3)
    assert box.shared(box) == pytest.approx(1, abs=1e-3) and box.shared(at(200, 200)) == 0
    assert text_mask([box], (80, 100)).sum() == pytest.approx(44 * 14, rel=0.25)


def test_a_box_at_the_edge_gives_a_rectangle_inside_of_the_image():
    assert rectangle(at(10, 95, 40, 20), (100, 200)) == (0, 85, 30, 15)


@pytest.mark.parametrize(("size", "color", "degrees"), [(0.45, WHITE, 0), (0.4, YELLOW, 0), (0.45, WHITE, 15)])
def test_small_text_is_found_and_covered(find, size, color, degrees):
    marked, ink = written(moving_tissue()[0], size=size, color=color, degrees=degrees)
    found = text_mask(find(marked), marked.shape)
    assert found[ink].mean() > 0.97 and found.sum() < 6 * ink.sum()


def test_tissue_has_no_text(find):
    assert [box for frame in moving_tissue() for box in find(frame)] == []


def test_text_at_one_place_is_confirmed_and_a_single_box_is_not():
    once = [[at(50, 50)], *[[]] * 6]
    assert confirm(once).static == confirm(once).moving == []
    assert confirm([[at(50, 50)]] * 2 + [[]] * 4).static == []
    (text,) = confirm([[], [at(50, 50)], [at(51, 50)], [at(30, 50, length=40)], []]).static
    assert text.seen == [1, 2, 3] and not confirm([[at(50, 50)]] * 3).moving
    assert rectangle(text.box, (100, 100)) == (10, 42, 81, 16), "from the first letter to the last one, and no higher"


def test_slots_of_a_tool_that_drifts_are_no_text():
    drifting = [[at(50 + 2 * k, 50 + 5 * k, 60, 22, 22 + k, 0.9)] for k in range(6)]
    assert confirm(drifting).static == confirm(drifting).moving == []
    weak = [[at(50, 50, score=0.8)]] * 4 + [[]] * 4
    assert confirm(weak).static == []


def test_text_that_moves_is_confirmed_by_its_size():
    places = [(50, 40), (150, 60), (80, 120), (160, 150)]
    (size,) = confirm([[at(*place)] for place in places]).moving
    assert (size.length, size.height) == (80, 16)
    assert not confirm([[at(*place, degrees=20)] for place in places]).moving, "a tool's slots are slanted"
    assert not confirm([[at(*place, length=60 + 30 * k)] for k, place in enumerate(places)]).moving


def test_text_that_leaves_its_place_moves():
    rests = [[at(50, 40)]] * 6
    assert confirm(rests).static and not confirm(rests).moving
    jumps = [*rests, [at(150, 140)], [at(150, 40)]]
    assert confirm(jumps).moving and not confirm(jumps).static
    flickers = [[at(50, 40, score=0.99)], []] * 6
    assert confirm(flickers).moving and not confirm(flickers).static
    assert confirm([[at(50, 40, score=0.9)], []] * 6).static, "faint text may only be missed"
    two = [[at(50, 40), at(150, 140)]] * 6
    assert len(confirm(two).static) == 2 and not confirm(two).moving


def test_text_that_moves_is_followed_at_its_own_scale():
    cut, slanted, high = at(10, 99, 40, 27), at(90, 90, 80, 27, 30), at(90, 90, 80, 60)
    texts, scales = [[at(50, 40, 80, 27)], [], [cut, slanted, high]], set()

    def finds(image, scale):
        scales.add(scale)
        return texts[int(image[0, 0, 0])]

    images = [np.full((100, 200, 3), k, np.uint8) for k in range(len(texts))]
    assert follow(images, [at(0, 0, 80, 27)], finds) == [texts[0], [], [cut]]
    assert scales == {18 / 27}


def test_a_name_at_rest_and_a_label_that_moves_over_tissue(find):
    named, labeled = [], []
    for k, frame in enumerate(moving_tissue()):
        named.append(written(frame)[0])
        labeled.append(written(frame, f"polyp: 0.9{k}", (20 + 14 * k, 40 + 16 * k)))
    ink = written(named[0])[1]
    (name,) = confirm([find(image) for image in named]).static
    assert text_mask([name.box], ink.shape)[ink].mean() > 0.97
    images = [image for image, _ in labeled]
    texts = confirm([find(image) for image in images])
    assert texts.moving and not texts.static
    for boxes, (_, true) in zip(follow(images, texts.moving, find), labeled, strict=True):
        assert text_mask(boxes, true.shape)[true].mean() > 0.95


def test_real_clip(find, real_clip):
    images = [read_color(real_clip / "images" / f"{i:06d}.png") for i in range(0, 90, 15)]
    (text,) = confirm([find(image) for image in images]).static  # the word "Left" in the corner
    x, y, width, height = rectangle(text.box, images[0].shape)
    assert x < 20 and y < 10 and 50 < width < 120 and 25 < height < 60
