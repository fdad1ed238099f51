"""Tools over a whole clip: regions with an outline, log-odds carried along the flow, and what most frames agree on."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from endoprior.tool_masks import over_time
from endoprior.tool_masks.over_time import KEEP, MAX_LOG_ODDS, FramePrediction, decide_over_time
from endoprior.tool_masks.regions import candidate_regions, tool_regions

HEIGHT, WIDTH = 96, 128
VIEW = np.ones((HEIGHT, WIDTH), bool)
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH)).astype(np.float32)
TISSUE = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 400, (HEIGHT, 300, 3)).astype(np.float32), (0, 0), 3)


def bar(left=40, right=60, end=60):
    """(h, w) True on a tool that comes in from above."""
    return (COLUMNS >= left) & (COLUMNS < right) & (ROWS < end)


def odds(*parts):
    """Log-odds of -5, and those of (mask, value) parts; later ones lie above."""
    out = np.full((HEIGHT, WIDTH), -5, np.float32)
    for mask, value in parts:
        out[mask] = value
    return out


def predicted(log_odds, shift=0):
    """Tissue that has moved to the left, px, and what the network says of it."""
    return FramePrediction(np.clip(TISSUE[:, shift : shift + WIDTH], 0, 255).astype(np.uint8), log_odds)


def iou(a, b):
    return (a & b).sum() / max((a | b).sum(), 1)


# ---- one frame


def test_a_tool_that_touches_what_is_half_a_tool_keeps_its_own_outline():
    half = (COLUMNS > 55) & (ROWS < 45)
    blurred = cv2.GaussianBlur(odds((half, 0.8)), (0, 0), 6)  # a dark corner: no level ends it
    found = tool_regions(np.where(bar(), np.float32(5), blurred), VIEW)
    assert iou(found, bar()) > 0.9


def test_a_faint_tool_with_an_outline_is_one_and_a_faint_slope_is_none():
    assert iou(tool_regions(odds((bar(), 0.6)), VIEW), bar()) > 0.85
    slope = (3 - np.hypot(ROWS, COLUMNS - 50) / 20).astype(np.float32)
    assert not tool_regions(slope, VIEW).any()


@pytest.mark.parametrize(
    ("mask", "value", "kept"),
    [
        (bar(), 4.0, True),
        ((ROWS > 30) & (ROWS < 60) & (COLUMNS > 40) & (COLUMNS < 80), 4.0, True),  # sure, beside the border
        ((ROWS > 30) & (ROWS < 60) & (COLUMNS > 40) & (COLUMNS < 80), 1.0, False),  # not sure, beside the border
        (ROWS < 12, 1.0, False),  # an organ along the border
        ((ROWS < 3) & (COLUMNS < 3), 4.0, False),  # too small
    ],
)
def test_a_region_is_sure_or_enters_end_first(mask, value, kept):
    found = candidate_regions(odds((mask, value)), VIEW)
    assert any(region.is_tool for region in found) == kept


def test_nothing_is_found_beyond_the_view():
    view = COLUMNS < 50
    assert not (tool_regions(odds((bar(), 5)), view) & ~view).any()


# ---- over time


def test_a_resting_frame_is_averaged_by_powers_of_keep():
    rng = np.random.default_rng(1)
    values = [rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32) for _ in range(5)]
    predictions = [predicted(value) for value in values]
    flows = [over_time.BidirectionalFlow.between(*pair) for pair in pairwise(predictions)]
    found = over_time.carried(values, flows)
    inner = np.s_[8:-8, 8:-8]
    for t, mean in enumerate(found):
        weights = KEEP ** np.abs(np.arange(5) - t)
        want = sum(w * value for w, value in zip(weights, values, strict=True)) / weights.sum()
        assert np.allclose(mean[inner], want[inner], atol=0.02)


def test_one_frame_alone_is_as_without_time():
    seen = odds((bar(), 5))
    (alone,) = decide_over_time([predicted(seen)], VIEW)
    assert (alone.tool_mask == tool_regions(seen, VIEW)).all()
    assert not list(decide_over_time([], VIEW))


@pytest.mark.parametrize("missed", [-1.0, 0.3])
def test_a_mask_that_goes_out_for_frames_or_merges_with_the_dark_stays(missed):
    """Seen before in a clip with smoke: 21 % of the picture, 0, 0, 15 %."""
    dark = (COLUMNS > 55) & (ROWS < 80)
    usual, bad = odds((bar(), 5)), odds((dark, 1.5), (bar(), 1.5)) if missed > 0 else odds((bar(), missed))
    predictions = [predicted(bad if t in (6, 7) else usual) for t in range(14)]
    found = list(decide_over_time(predictions, VIEW))
    assert all(iou(tools.tool_mask, bar()) > 0.7 for tools in found)


def test_what_flares_up_in_one_frame_is_no_tool():
    predictions = [predicted(odds((bar(80, 100), 1.5 if t == 5 else -3))) for t in range(12)]
    assert not any(tools.tool_mask.any() for tools in decide_over_time(predictions, VIEW))


def test_log_odds_move_with_the_image():
    """A tool that goes to the left by 2 px a frame with the image, and is missed in two frames."""
    bars = [bar(70 - 2 * t, 90 - 2 * t) for t in range(12)]
    predictions = [predicted(odds((bars[t], -1 if t in (5, 6) else 5)), shift=2 * t) for t in range(12)]
    for t, tools in enumerate(decide_over_time(predictions, VIEW)):
        assert iou(tools.tool_mask, bars[t]) > 0.8, t


def test_nothing_is_carried_over_a_cut():
    there = [predicted(odds((bar(), 5))) for _ in range(6)]
    other = [FramePrediction(255 - each.rgb_u8, odds()) for each in there]
    found = list(decide_over_time([*there, *other], VIEW))
    assert all(tools.tool_mask.any() for tools in found[:6]) and not any(tools.tool_mask.any() for tools in found[6:])


def test_a_long_clip_is_decided_in_chunks_that_know_their_neighbors(monkeypatch):
    rng = np.random.default_rng(2)
    predictions = [predicted(odds((bar(), float(rng.normal(1, 3))))) for _ in range(40)]
    whole = [tools.tool_mask for tools in decide_over_time(predictions, VIEW)]
    monkeypatch.setattr(over_time, "CHUNK", 9)
    monkeypatch.setattr(over_time, "MARGIN", 12)
    parts = [tools.tool_mask for tools in decide_over_time(predictions, VIEW)]
    assert len(parts) == 40
    assert np.mean([iou(a, b) if a.any() or b.any() else 1 for a, b in zip(whole, parts, strict=True)]) > 0.95


def test_sure_frames_do_not_outweigh_all_others():
    predictions = [predicted(odds((bar(), 1000.0 if t == 0 else -3.0))) for t in range(10)]
    found = list(decide_over_time(predictions, VIEW))
    assert MAX_LOG_ODDS < 1000 and not any(tools.tool_mask.any() for tools in found[3:])
