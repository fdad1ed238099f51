"""A mask correction carried along the optical flow: known motion, a cut, a region that leaves, masks that agree."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.footage.carry_masks import carry_mask_edit, sampled

WIDTH, HEIGHT = 160, 128
SIDE = 40
NO_MASK = np.zeros((HEIGHT, WIDTH), bool)


def carried(frames, masks, frame, edited):
    return carry_mask_edit(frames.__getitem__, masks.__getitem__, len(frames), frame, edited)


def texture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """(height, width, 3) smooth noise over the whole range of levels."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((height, width, 3)), (0, 0), 3)
    return np.uint8(255 * (noise - noise.min()) / np.ptp(noise))


def square_at(x: float, y: float, shape=(HEIGHT, WIDTH)) -> np.ndarray:
    """The mask of a square with its upper left corner at this position."""
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    return (columns >= x) & (columns < x + SIDE) & (rows >= y) & (rows < y + SIDE)


def moving_square(steps, *, scale: int = 1, seed: int = 1):
    """Frames in which a textured square moves over another texture, and its true masks; `steps` are its corners."""
    height, width, side = scale * HEIGHT, scale * WIDTH, scale * SIDE
    ground, square = texture(0, height, width), texture(seed, side, side)
    frames, masks = [], []
    for x, y in steps:
        frame, mask = ground.copy(), np.zeros((height, width), bool)
        x, y = scale * x, scale * y
        inside = np.s_[max(y, 0) : max(y + side, 0), max(x, 0) : max(x + side, 0)]
        shown = square[max(-y, 0) :, max(-x, 0) :]
        frame[inside] = shown[: height - max(y, 0), : width - max(x, 0)]
        mask[inside] = True
        frames.append(frame)
        masks.append(mask)
    return frames, masks


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("scale", [1, 2])  # at 2 the flow is computed at half size
@pytest.mark.parametrize("step", [(2, 0), (-1, 2), (0, 0)])
def test_a_painted_region_follows_a_known_motion_both_ways(scale, step):
    frames, true = moving_square([(50 + step[0] * k, 40 + step[1] * k) for k in range(-4, 5)], scale=scale)
    nothing = [np.zeros_like(true[0])] * 9
    done = carried(frames, nothing, 4, true[4])
    assert list(done.masks) == [0, 1, 2, 3, 5, 6, 7, 8]
    assert all(overlap(mask, true[k]) > 0.95 for k, mask in done.masks.items())
    assert (done.before, done.after) == ("the first frame", "the last frame")


def test_errors_of_noisy_frames_do_not_add_up():
    frames, true = moving_square([(round(55 + 30 * np.sin(k / 4)), round(40 + 20 * np.sin(k / 5))) for k in range(30)])
    rng = np.random.default_rng(0)
    noisy = [np.clip(frame + rng.normal(0, 12, frame.shape), 0, 255).astype(np.uint8) for frame in frames]
    done = carried(noisy, [NO_MASK] * 30, 0, true[0])
    assert len(done.masks) == 29 and all(overlap(mask, true[k]) > 0.97 for k, mask in done.masks.items())


def test_an_erased_region_follows_too_and_the_rest_stays():
    frames, square = moving_square([(40 + 2 * k, 40) for k in range(5)])
    other = square_at(110, 80)
    masks = [mask | other for mask in square]
    done = carried(frames, masks, 0, other)
    assert list(done.masks) == [1, 2, 3, 4]
    for mask in done.masks.values():
        assert (mask & other).sum() == other.sum()
        assert (mask & ~other).sum() < 0.06 * square[0].sum()
    assert done.before == "the first frame"


@pytest.mark.parametrize(
    ("step", "later", "stops"),
    [
        (1, lambda frame, k: texture(6 + k), "frame 4: the motion is uncertain"),
        (0, lambda frame, k: frame // 3, "frame 4: the color of the region changed"),
    ],
    ids=["a cut", "another color"],
)
def test_it_stops_where_it_cannot_go_on(step, later, stops):
    frames, true = moving_square([(50 + step * k, 40) for k in range(7)])
    done = carried([frame if k < 4 else later(frame, k) for k, frame in enumerate(frames)], [NO_MASK] * 7, 1, true[1])
    assert list(done.masks) == [0, 2, 3] and done.after.startswith(stops)


def test_it_stops_when_the_region_leaves():
    steps = [(60 - 6 * k, 40) for k in range(20)]
    frames, true = moving_square(steps)
    done = carried(frames, [NO_MASK] * 20, 0, true[0])
    last = max(done.masks)
    assert "left" in done.after and 0.5 <= true[last].mean() / true[0].mean() < 0.7
    assert all(overlap(mask, true[k]) > 0.95 for k, mask in done.masks.items())


def test_a_mask_that_has_the_correction_already_is_left_alone_but_later_ones_are_not():
    frames, true = moving_square([(50 + k, 40) for k in range(4)])
    known = cv2.dilate(true[1].astype(np.uint8), np.ones((5, 5))) > 0
    done = carried(frames, [NO_MASK, known, NO_MASK, NO_MASK], 0, true[0])
    assert list(done.masks) == [2, 3]


def test_without_a_correction_nothing_changes():
    frames, true = moving_square([(50, 40)] * 3)
    done = carried(frames, true, 1, true[1])
    assert not done.masks and done.before == done.after == "nothing was corrected"


def test_arguments_are_not_changed_and_wrong_ones_are_rejected():
    frames, true = moving_square([(50, 40)] * 3)
    masks = [NO_MASK.copy() for _ in frames]
    carried(frames, masks, 0, true[0])
    assert not any(mask.any() for mask in masks)
    with pytest.raises(IndexError, match="frame_index"):
        carried(frames, masks, 3, true[0])
    with pytest.raises(ValueError, match="edited"):
        carried(frames, masks, 0, true[0][1:])
    with pytest.raises(ValueError, match="32 px"):
        carried([frame[:20] for frame in frames], [mask[:20] for mask in masks], 0, true[0][:20])


def test_sampling_equals_a_slow_loop():
    rng = np.random.default_rng(3)
    values = rng.random((9, 11)).astype(np.float32)
    positions = rng.uniform(0, 8, (5, 6, 2)).astype(np.float32)
    positions[0, 0] = np.nan
    positions[0, 1] = 40, 3
    found = sampled(values, positions)
    for row in range(5):
        for column in range(6):
            x, y = positions[row, column]
            if np.isnan(x):
                assert np.isnan(found[row, column])
                continue
            x = min(x, 10 - 1e-6)  # the nearest pixel of the border
            i, j, a, b = int(y), int(x), y - int(y), x - int(x)
            low = (1 - b) * values[i, j] + b * values[i, j + 1]
            high = (1 - b) * values[i + 1, j] + b * values[i + 1, j + 1]
            assert found[row, column] == pytest.approx((1 - a) * low + a * high, abs=0.04)  # OpenCV: 1/32 px
    mask = values > 0.5
    grid = np.dstack(np.meshgrid(np.arange(11, dtype=np.float32), np.arange(9, dtype=np.float32)))
    assert np.array_equal(sampled(mask, grid), mask)
