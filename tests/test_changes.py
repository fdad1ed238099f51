"""Duplicates, exposure jumps, cuts, blur and other scenes: each is created on purpose and detected."""

import cv2
import numpy as np
import pytest

from endoprior.footage.changes import find_changes, find_duplicates

COUNT, HEIGHT, WIDTH = 24, 120, 160


def texture(seed: int) -> np.ndarray:
    """(2H, 2W, 3) smooth reddish blobs, float levels."""
    noise = np.random.default_rng(seed).normal(size=(2 * HEIGHT, 2 * WIDTH)).astype(np.float32)
    waves = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 4, 12))
    return np.clip(130 + 60 * waves / waves.std(), 20, 235)[..., None] * np.array([1.0, 0.5, 0.45])


def clip(noise: float = 1.5, step: float = 1.0) -> list[np.ndarray]:
    """COUNT noisy images of tissue that slides by `step` px each."""
    rng, wide = np.random.default_rng(1), texture(0)
    images = []
    for i in range(COUNT):
        shift = np.array([[1, 0, -step * i], [0, 1, 0]], np.float32)
        moved = cv2.warpAffine(wide, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
        images.append(np.clip(moved + rng.normal(0, noise, moved.shape), 0, 255).astype(np.uint8))
    return images


def odd(changes) -> dict[str, tuple[int, ...]]:
    """What was found, by name, without what was not."""
    names = ("duplicates", "exposure_jumps", "cuts", "blurred", "off_color")
    return {name: getattr(changes, name) for name in names if getattr(changes, name)}


@pytest.mark.parametrize("options", [{}, {"step": 0.0}, {"step": 3.0}, {"noise": 0.5, "step": 0.2}])
def test_a_clean_clip_has_no_changes(options):
    changes = find_changes(clip(**options))
    assert odd(changes) == {}
    assert changes.brightness.shape == changes.sharpness.shape == (COUNT,) and changes.difference.shape == (COUNT - 1,)


def test_duplicates_are_detected():
    images = clip()
    images[7] = images[6]
    images[15] = images[14]
    assert odd(find_changes(images)) == {"duplicates": (7, 15)}
    assert find_changes([p for p in clip() for _ in range(2)]).duplicates == tuple(range(1, 2 * COUNT, 2))


def test_duplicates_after_video_coding_but_not_a_static_scene():
    images = clip(noise=0.5)
    residue = np.random.default_rng(2).random((HEIGHT, WIDTH, 1)) < 0.06  # what is left after coding, one level
    images[9] = images[8] + residue.astype(np.uint8)
    assert find_changes(images).duplicates == (9,)
    moving_then_resting = np.array([2.0] * 12 + [0.15] * 12)
    assert find_duplicates(moving_then_resting) == ()
    assert find_duplicates(np.array([2.0, 2.0, 0.1, 2.0, 2.0])) == (3,)
    assert find_duplicates(np.zeros(0)) == ()


@pytest.mark.parametrize("gain", [0.75, 1.3])
def test_an_exposure_jump_is_detected_at_its_frame(gain):
    images = [np.clip(p * (gain if i >= 10 else 1.0), 0, 255).astype(np.uint8) for i, p in enumerate(clip())]
    assert odd(find_changes(images)) == {"exposure_jumps": (10,)}


def test_a_slow_drift_and_a_dark_tool_are_no_exposure_jumps():
    drifting = [(p * (1 - 0.015 * i)).astype(np.uint8) for i, p in enumerate(clip())]
    assert odd(find_changes(drifting)) == {}
    with_tool = clip()
    for image in with_tool[10:]:
        image[:, :90] = 40
    assert find_changes(with_tool).exposure_jumps == ()


def test_a_cut_is_a_cut_and_not_an_exposure_jump():
    other = (0.5 * texture(5)[:HEIGHT, :WIDTH]).astype(np.uint8)
    images = clip()[:12] + [np.roll(other, i, 1) for i in range(12)]
    found = find_changes(images)
    assert found.cuts == (12,) and found.exposure_jumps == ()


def view(tissue: np.ndarray, x: float, y: float = 0.0) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) uint8: what a camera that looks at (x, y), px, sees of tissue (2H, 2W, 3)."""
    shift = np.array([[1, 0, -x], [0, 1, -y]], np.float32)
    return cv2.warpAffine(tissue, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT).astype(np.uint8)


def smooth(seed: int) -> np.ndarray:
    """(2H, 2W, 3) tissue of broad shades without corners, float levels."""
    blurred = cv2.GaussianBlur(texture(seed), (0, 0), 12)
    return np.clip(130 + 4 * (blurred - blurred.mean()), 20, 235)


FAR = 0.4 * WIDTH
JERKS = {
    "returns": [FAR * (i in (11, 12, 13)) for i in range(COUNT)],
    "stays": [FAR * (i > 11) for i in range(COUNT)],
    "fast": [FAR / 2 * np.clip(i - 10, 0, 3) for i in range(COUNT)],
}
"""Where the camera looks in each image, px."""


@pytest.mark.parametrize(
    ("tissue", "jerk"), [(texture, each) for each in JERKS] + [(smooth, "returns"), (smooth, "fast")]
)
def test_a_jerk_of_the_camera_is_no_cut(tissue, jerk):
    images = [view(tissue(0), x + 0.5 * i, 20) for i, x in enumerate(JERKS[jerk])]
    assert find_changes(images).cuts == ()


@pytest.mark.parametrize("tissue", [texture, smooth])
@pytest.mark.parametrize("lasts", [1, 3])
def test_a_fold_that_swings_in_is_no_cut(tissue, lasts):
    fold, images = 0.8 * tissue(3)[:HEIGHT, :WIDTH], [view(tissue(0), 0.5 * i) for i in range(COUNT)]
    for i, image in enumerate(images[12:], 1):
        width = round(WIDTH / 2 * min(i / lasts, 1))
        image[:, :width] = fold[:, :width]
    assert find_changes(images).cuts == ()


@pytest.mark.parametrize("tissue", [texture, smooth])
def test_a_cut_is_found_also_behind_a_flash_or_a_short_shot(tissue):
    images = [view(tissue(0 if i < 12 else 5), 0.5 * i) for i in range(COUNT)]
    assert find_changes(images).cuts == (12,)
    for other in (np.full_like(images[0], 250), view(tissue(7), 30)):
        assert find_changes([*images[:5], other, *images[5:12]]).cuts == ()
        for count in (1, 2, 3):
            assert find_changes(images[:12] + [other] * count + images[12:]).cuts != ()


def test_a_sweep_of_views_none_of_which_lasts_is_no_cut():
    images = [view(smooth(max(i - 8, 0)), 30) for i in range(18)]  # from image 9 on another view each time
    assert find_changes(images).cuts == ()


def test_blur_and_other_colors_are_detected():
    images = clip()
    images[6] = cv2.GaussianBlur(images[6], (0, 0), 4)
    images[12] = np.ascontiguousarray(images[12][..., [1, 0, 2]])  # white balance: the same view in another color
    images[18] = np.ascontiguousarray(images[18][::-1, ::-1, [1, 0, 2]])
    found = find_changes(images)
    assert found.blurred == (6,) and found.off_color == (18,)


def test_one_image_has_no_changes():
    changes = find_changes(clip()[:1])
    assert odd(changes) == {} and changes.difference.shape == (0,)


@pytest.mark.slow
def test_the_real_clip_has_no_changes(real_clip):
    images = [cv2.imread(str(file))[..., ::-1] for file in sorted((real_clip / "images").iterdir())]
    assert odd(find_changes(images)) == {}
