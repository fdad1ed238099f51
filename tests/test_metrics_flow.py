"""Flow error: its arithmetic with a made-up estimator, and real estimators on a shifted texture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.evaluation.score import ScoreUnavailable
from endoprior.evaluation.scorers.motion import dis_flow, flow_error


def texture(height: int, width: int, shift: tuple[int, int] = (0, 0), seed: int = 0) -> np.ndarray:
    """(H, W, 3) uint8 crop of a smooth random texture; `shift` (x, y) px moves its content, at most 10 px."""
    noise = np.random.default_rng(seed).normal(size=(height + 20, width + 20, 3))
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    x, y = 10 - shift[0], 10 - shift[1]
    return np.ascontiguousarray(smooth[y : y + height, x : x + width])


class BrightnessFlow:
    """A flow one can do in one's head: (difference of red, difference of green) in px."""

    def __call__(self, first, second):
        return (second.astype(np.float32) - first.astype(np.float32))[..., :2]


def frames(values: list[tuple[int, int]]) -> list[np.ndarray]:
    """One (4, 5, 3) uint8 image per (red, green)."""
    return [np.broadcast_to(np.array([r, g, 0], np.uint8), (4, 5, 3)).copy() for r, g in values]


MASK = np.ones((4, 5), bool)


def test_flow_error_is_the_mean_end_point_distance():
    targets, renders = frames([(0, 0), (10, 0), (10, 0)]), frames([(0, 0), (13, 4), (13, 4)])
    assert flow_error(renders[:2], targets[:2], [MASK] * 2, BrightnessFlow()) == 5  # (3, 4) px apart
    assert flow_error(renders[1:], targets[1:], [MASK] * 2, BrightnessFlow()) == 0  # both at rest


def test_flow_error_sees_masked_images_and_scores_the_common_tissue():
    left, right = MASK.copy(), MASK.copy()
    left[:, 3:], right[:, :1] = False, False
    targets, renders = frames([(0, 0), (10, 0)]), frames([(0, 0), (13, 4)])
    for image in (*targets, *renders):
        image[:, 0] = 255  # scored by no pair: outside the second mask
    seen = []

    class Recorder(BrightnessFlow):
        def __call__(self, first, second):
            seen.append((first, second))
            return super().__call__(first, second)

    assert flow_error(renders, targets, [left, right], Recorder()) == 5
    assert len(seen) == 2
    for first, second in seen:
        assert not first[:, 3:].any() and not second[:, :1].any()


@pytest.mark.parametrize("shift", [(3, 2), (-5, 4)])
def test_dis_recovers_a_shift(shift):
    flow = dis_flow(texture(96, 128), texture(96, 128, shift))
    assert flow.shape == (96, 128, 2)
    # 0.2 px: the medium preset stops at 1/2 resolution; 0.01 px is measured on this texture.
    assert np.abs(np.median(flow, (0, 1)) - shift).max() < 0.2


def test_dis_error_of_the_target_against_itself_is_zero_and_of_a_frozen_render_is_the_motion():
    targets = [texture(96, 128), texture(96, 128, (3, 4))]
    masks = [np.ones((96, 128), bool)] * 2
    assert flow_error(targets, targets, masks, dis_flow) == 0
    frozen = flow_error([targets[0]] * 2, targets, masks, dis_flow)
    assert frozen == pytest.approx(5, abs=0.3)  # px; mean over the frame, whose borders have no match


def test_dis_repeats_bit_for_bit_whatever_the_threads():
    noise = np.random.default_rng(0).integers(0, 256, (192, 256, 3), dtype=np.uint8)
    moved = np.roll(noise, (3, -5), (0, 1))
    before = cv2.getNumThreads()
    try:
        flows = []
        for threads in (1, 1, 2, 5):
            cv2.setNumThreads(threads)
            flows.append(dis_flow(noise, moved))
    finally:
        cv2.setNumThreads(before)
    assert all(np.array_equal(flows[0], flow) for flow in flows[1:])


def test_dis_names_images_that_are_too_small():
    with pytest.raises(ScoreUnavailable, match="at least 32 px a side; got 31x40"):
        dis_flow(texture(40, 31), texture(40, 31))
