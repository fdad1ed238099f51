"""Prompts, chunks, both directions and the union of what is carried: with a stand-in that follows colors."""

import numpy as np
import pytest
from tiny_sam2 import ColorSegmenter

from endoprior.data import FrameSequence
from endoprior.tool_masks import FoundTools, video_segmenter
from endoprior.tool_masks.mask_store import MaskStore
from endoprior.tool_masks.video_segmenter import (
    MAX_REGIONS,
    Prompt,
    carry,
    choose_prompts,
    rim_px,
    segment_sequence,
    sure_regions,
    with_rim,
)

HEIGHT, WIDTH = 60, 80
COLORS = {"a": (0, 0, 200), "b": (0, 200, 0)}


def image(number, **boxes):
    """A gray frame with boxes of a color each; its number is the red channel of the first pixel."""
    rgb = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for name, (x, y, width, height) in boxes.items():
        rgb[y : y + height, x : x + width] = COLORS[name]
    rgb[0, 0] = (number, 0, 0)
    return rgb


def box(x, y, width, height):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[y : y + height, x : x + width] = True
    return mask


def test_the_best_frame_of_each_stretch_is_carried_to_the_next_ones():
    scores = [0, 5, 9, 0, 0, 0, 0, 0, 7, 0]
    assert choose_prompts(scores, 4) == [Prompt(2, 0, 8), Prompt(8, 2, 9)]
    assert choose_prompts(scores, 100) == [Prompt(2, 0, 9)]
    assert choose_prompts([0.0] * 9, 4) == [] and choose_prompts([], 4) == []
    assert choose_prompts([3, 3], 4) == [Prompt(0, 0, 1)], "of equal frames the first"


def test_sure_regions_lose_their_rim_and_come_largest_first():
    mask = box(0, 10, 20, 10) | box(40, 10, 30, 30) | box(30, 50, 2, 2)
    first, second = sure_regions(mask)
    assert first.sum() > second.sum() and rim_px(WIDTH) == 1
    assert (first == box(41, 11, 28, 28)).all()
    assert (second == box(0, 11, 19, 8)).all(), "nothing is taken off at the image's edge"
    assert (with_rim(first) <= box(40, 10, 30, 30)).all(), "the rim comes back and not more"
    assert len(sure_regions(mask, covered=first)) == 1
    bridge = box(10, 10, 20, 20) | box(40, 10, 20, 20) | box(30, 20, 10, 2)
    assert len(sure_regions(bridge)) == 2, "a thin bridge does not make one object of two"
    many = np.any([box(10 * i, 10, 8, 8) for i in range(8)], axis=0)
    assert len(sure_regions(many)) == MAX_REGIONS
    assert sure_regions(np.zeros_like(mask)) == []


@pytest.mark.parametrize("order", [range(3, 12), range(11, 2, -1)])
def test_chunks_see_the_first_frame_and_the_last_of_the_chunk_before(monkeypatch, order):
    monkeypatch.setattr(video_segmenter, "CHUNK", 3)
    frames = [image(i, a=(2 * i, 10, 10, 10)) for i in range(12)]
    segmenter, first = ColorSegmenter(), order[0]
    found = dict(carry(segmenter, lambda i: frames[i], order, [box(2 * first, 10, 10, 10)]))
    assert list(found) == list(order[1:])
    assert all((found[i] == box(2 * i, 10, 10, 10)).all() for i in found)
    chunks = [list(order[1:])[at : at + 3] for at in range(0, 8, 3)]
    assert [chunk.followed for chunk in segmenter.chunks] == chunks
    shown = [[number for number, _ in chunk.shown] for chunk in segmenter.chunks]
    assert shown == [[first], [first, order[3]], [first, order[6]]]
    assert all(areas == [100] for chunk in segmenter.chunks for _, areas in chunk.shown)


def test_frames_are_decoded_one_at_a_time(monkeypatch):
    monkeypatch.setattr(video_segmenter, "CHUNK", 3)
    asked = []

    def frame(i):
        asked.append(i)
        return image(i, a=(10, 10, 10, 10))

    for _ in carry(ColorSegmenter(), frame, range(8), [box(10, 10, 10, 10)]):
        pass
    assert asked == [0, 1, 2, 3, 0, 3, 4, 5, 6, 0, 6, 7]


def test_a_carry_ends_where_all_objects_have_left(monkeypatch):
    monkeypatch.setattr(video_segmenter, "PATIENCE", 2)
    frames = [image(i, **({"a": (10, 10, 9, 9)} if i in (0, 2) else {})) for i in range(9)]
    found = [i for i, _ in carry(ColorSegmenter(), lambda i: frames[i], range(9), [box(10, 10, 9, 9)])]
    assert found == [1, 2, 3, 4], "one empty frame is waited for, two are not"


class Frames:
    """A sequence of painted frames."""

    frames_per_second, depth_is_relative = 25.0, True

    def __init__(self, images):
        self.images = images

    def __len__(self):
        return len(self.images)

    def camera(self, index):
        return type("Camera", (), {"width": WIDTH, "height": HEIGHT})

    def frame(self, index):
        return type("Frame", (), {"rgb_u8": self.images[index], "tissue_mask": ~box(70, 50, 5, 5)})


def clip(monkeypatch, images, found, outside=None):
    """A sequence whose own finder finds `found`, {frame: (mask, confidence)}."""
    outside = np.zeros((HEIGHT, WIDTH), bool) if outside is None else outside
    nothing = np.zeros((HEIGHT, WIDTH), bool), 1.0

    def find(sequence, *, refine, progress):
        for i in range(len(sequence)):
            mask, confidence = found.get(i, nothing)
            yield mask | outside, FoundTools(mask, confidence)

    monkeypatch.setattr(video_segmenter, "find_in_sequence", find)
    sequence: FrameSequence = Frames(images)
    return sequence


TOOL = (20, 20, 16, 16)


def test_one_found_frame_reaches_the_whole_clip_in_both_directions(monkeypatch, tmp_path):
    images = [image(i, a=TOOL) for i in range(10)]
    sequence = clip(monkeypatch, images, {4: (box(*TOOL), 0.9), 7: (box(*TOOL), 0.3)}, outside=box(0, 0, 2, HEIGHT))
    segmenter = ColorSegmenter()
    results = list(segment_sequence(sequence, segmenter, tmp_path))
    for i, (mask, tools) in enumerate(results):
        assert (tools.tool_mask >= box(21, 21, 14, 14)).all() and tools.tool_mask.sum() < 1.4 * 16 * 16, (
            "the tool and its rim"
        )
        assert (mask == tools.tool_mask | box(0, 0, 2, HEIGHT)).all()
        assert (tools.confidence < 0.5) == (i != 4), "the finder and the segmenter disagree"
    assert [chunk.shown[0][0] for chunk in segmenter.chunks] == [4, 4], "forward and backward, from the surest frame"


def test_a_tool_that_enters_between_prompted_frames_is_carried_in_a_second_round(monkeypatch, tmp_path):
    late = (55, 30, 12, 12)
    images = [image(i, a=TOOL, **({"b": late} if 3 <= i < 8 else {})) for i in range(12)]
    found = {0: (box(*TOOL), 1.0), 5: (box(*late), 0.8)}
    sequence = clip(monkeypatch, images, found)
    for i, (mask, _) in enumerate(segment_sequence(sequence, ColorSegmenter(), tmp_path)):
        assert mask[28, 28] and mask[36, 61] == (3 <= i < 8)


def test_stretches_have_prompts_of_their_own(monkeypatch, tmp_path):
    monkeypatch.setattr(video_segmenter, "choose_prompts", lambda scores: choose_prompts(scores, 5))
    images = [image(i, **{"a" if i < 6 else "b": TOOL}) for i in range(12)]
    sequence = clip(monkeypatch, images, {2: (box(*TOOL), 1.0), 8: (box(*TOOL), 1.0)})
    masks = [mask for mask, _ in segment_sequence(sequence, ColorSegmenter(), tmp_path)]
    assert all(mask[28, 28] for mask in masks), "each prompt carries one color, and the union has both"


def test_the_order_of_merging_does_not_matter(tmp_path):
    rng = np.random.default_rng(0)
    masks = rng.random((4, HEIGHT, WIDTH)) > 0.7
    stores = [MaskStore(tmp_path / name, (WIDTH, HEIGHT)) for name in "ab"]
    for i in (0, 1, 2, 3):
        stores[0].add(5, masks[i])
    for i in (3, 1, 0, 2, 1):
        stores[1].add(5, masks[i])
    assert (stores[0].mask(5) == masks.any(0)).all() and (stores[0].mask(5) == stores[1].mask(5)).all()
    assert list(stores[0]) == [5] and len(stores[0]) == 1 and not stores[0].mask(4).any()
    with pytest.raises(KeyError):
        stores[0][4]


def test_refining_keeps_the_given_masks_and_a_clip_without_tools_stays_empty(monkeypatch, tmp_path):
    sequence = clip(monkeypatch, [image(i, a=TOOL) for i in range(3)], {0: (box(*TOOL), 1.0)})
    for mask, _ in segment_sequence(sequence, ColorSegmenter(), tmp_path / "refined", refine=True):
        assert mask[52, 72] and mask[28, 28]
    segmenter = ColorSegmenter()
    results = list(segment_sequence(clip(monkeypatch, [image(0), image(1)], {}), segmenter, tmp_path / "empty"))
    assert not any(mask.any() for mask, _ in results) and all(tools.confidence == 1 for _, tools in results)
    assert not segmenter.chunks


def test_an_interrupted_run_resumes_and_gives_the_same_masks(monkeypatch, tmp_path):
    images = [image(i, a=TOOL, **({"b": (55, 30, 12, 12)} if i > 6 else {})) for i in range(12)]
    found = {2: (box(*TOOL), 1.0), 9: (box(55, 30, 12, 12), 0.9)}
    sequence = clip(monkeypatch, images, found)
    whole = [mask for mask, _ in segment_sequence(sequence, ColorSegmenter(), tmp_path / "whole")]
    frames_at_once = []
    for stop in range(1, 60, 4):

        class Stopped(ColorSegmenter):
            left = stop

            def begin(self):
                chunk = super().begin()
                follow = chunk.follow

                def counted(rgb_u8):
                    Stopped.left -= 1
                    if Stopped.left < 0:
                        raise KeyboardInterrupt
                    return follow(rgb_u8)

                chunk.follow = counted
                return chunk

        try:
            masks = [mask for mask, _ in segment_sequence(sequence, Stopped(), tmp_path / "parts")]
        except KeyboardInterrupt:
            continue
        frames_at_once.append(stop)
        assert all((a == b).all() for a, b in zip(masks, whole, strict=True))
    assert frames_at_once and frames_at_once[0] > 1, "it was interrupted at least once"
