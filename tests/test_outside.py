"""Borders of any shape, and drawings in single frames: found where they are, and tissue stays."""

import cv2
import numpy as np
import pytest
from painted_borders import HEIGHT, NOT_ROUND, WIDTH, finish, tissue

from endoprior.data.images import read_color
from endoprior.footage.border import find_outline, find_outside, hidden_by_moving_border
from endoprior.footage.overlays import find_strokes, without_strokes
from endoprior.phantom import PhantomConfig, write_phantom

RED = (250, 10, 20)


def shape(name):
    """(H, W) True where the picture is."""
    seen, (right, down) = np.zeros((HEIGHT, WIDTH), np.uint8), (WIDTH - 1, HEIGHT - 1)
    if name == "octagon":
        corners = [(60, 0), (right - 60, 0), (right, 60), (right, down - 60), (right - 60, down), (60, down)]
        cv2.fillPoly(seen, [np.int32([*corners, (0, down - 60), (0, 60)])], 1)
    elif name == "oval":
        cv2.ellipse(seen, (150, 118), (130, 100), 0, 0, 360, 1, -1)
    elif name == "rounded":
        seen[30 : HEIGHT - 30, 60 : WIDTH - 60] = 1
        seen = cv2.dilate(seen, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (51, 51)))
    elif name == "slanted margin":  # more than half of the frame
        cv2.fillPoly(seen, [np.int32([(90, 20), (250, 35), (235, 190), (100, 200)])], 1)
    elif name == "two images":
        seen[30:210, 10:200] = seen[60:150, 220:310] = 1
    return seen > 0


def clip(seen, seed=0, **of):
    rng = np.random.default_rng(seed)
    return finish([image * seen[..., None] for image in tissue(rng, **of)], rng)


@pytest.mark.parametrize("name", ["octagon", "oval", "rounded", "slanted margin"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_border_of_any_shape_is_masked_and_tissue_stays(name, seed):
    seen = shape(name)
    found = find_outside(clip(seen, seed))
    inner = cv2.erode(seen.astype(np.uint8), np.ones((9, 9))) > 0
    assert (~found.mask & ~seen).sum() < 0.002 * seen.size and found.sharpness > 0.9
    assert (found.mask & inner).sum() < 0.005 * seen.sum()
    assert (found.mask & ~seen).sum() / (found.mask | ~seen).sum() > 0.9


def test_the_largest_of_several_images_is_taken():
    found = find_outside(clip(shape("two images")))
    assert found.images == 2 and found.mask[60:150, 220:310].all() and not found.mask[40:200, 20:190].any()


@pytest.mark.parametrize("kind", ["plain", "vignetting", "dark cavity"])
def test_dark_tissue_is_no_border(kind):
    assert not find_outside(NOT_ROUND[kind](np.random.default_rng(1)).images).mask.any()


def test_a_dark_tool_that_rests_at_the_border_is_not_outside():
    seen = shape("octagon")
    images = clip(seen)
    for image in images:
        image[110:130, :140] = 3
    assert not find_outside(images).mask[112:128, 20:135].any()


def test_a_border_that_moves_is_masked_in_each_image():
    rng, images, seen = np.random.default_rng(0), [], []
    for i, image in enumerate(tissue(rng)):
        seen.append(np.roll(shape("oval"), 3 * i, 1))
        images.append(image * seen[-1][..., None])
    images = finish(images, rng)
    found = find_outside(images)
    assert found.moves and not find_outside(clip(shape("oval"))).moves
    for image, true in zip(images, seen, strict=True):
        hidden = found.mask | hidden_by_moving_border(image, found.level, ~found.mask)
        assert (~hidden & ~true).sum() < 0.01 * true.size and (hidden & true).sum() < 0.08 * true.sum()


def with_box(image, at, text="polyp: 0.93"):
    """An image with a box and its text, and where they are."""
    drawn = image.copy()
    cv2.rectangle(drawn, at, (at[0] + 90, at[1] + 70), RED, 2)
    cv2.putText(drawn, text, (at[0] + 4, at[1] + 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, RED, 1)
    return drawn, (drawn != image).any(-1)


def test_boxes_and_text_that_move_are_found_in_each_image():
    images = clip(np.ones((HEIGHT, WIDTH), bool))
    for i, image in enumerate(images):
        drawn, true = with_box(image, (10 + 20 * i, 5 + 14 * i))
        found = find_strokes(finish([drawn], np.random.default_rng(i), noise=0, quality=90)[0])
        near = cv2.dilate(true.astype(np.uint8), np.ones((9, 9))) > 0
        assert (found & true).sum() > 0.95 * true.sum() and not (found & ~near).any()
        assert not find_strokes(image).any()


def test_a_box_over_the_border_does_not_hide_it():
    seen = shape("octagon")
    images = [with_box(image, (8 * i, 0))[0] for i, image in enumerate(clip(seen))]
    outline = find_outline(without_strokes(images))
    assert (~outline.outside & ~seen).sum() < 0.002 * seen.size


@pytest.mark.parametrize("border", ["octagon", "oval", "rounded"])
def test_border_and_drawings_of_a_phantom_are_found(tmp_path, border):
    out = tmp_path / "p"
    write_phantom(
        out, PhantomConfig(frames=10, width=320, height=256, border=border, overlay=True, side_views=False, tracks=4)
    )
    images = [read_color(file) for file in sorted((out / "images").iterdir())]
    outline, true = find_outline(without_strokes(images)), np.load(out / "truth" / "border.npy")
    found = outline.outside | outline.in_strip
    inner = cv2.dilate(true.astype(np.uint8), np.ones((13, 13))) == 0  # the rim counts for neither
    assert (found & true).sum() > 0.97 * true.sum() and (found & inner).sum() < 0.005 * inner.sum()
    assert (found & true).sum() > 0.8 * (found | true).sum()
    for index, image in enumerate(images):
        drawn = np.load(out / "truth" / "overlay" / f"{index:06d}.npy")
        near = cv2.dilate(drawn.astype(np.uint8), np.ones((9, 9))) > 0
        strokes = find_strokes(image)
        assert (strokes & drawn).sum() >= 0.99 * drawn.sum() and (strokes & ~near).sum() < 0.005 * near.size
