"""`prepare` paints burnt-in text black and masks it, in the frames that show it, and says where it is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from endoprior.data import load_sequence
from endoprior.data.images import save_png
from endoprior.footage.text_network import TextBox
from endoprior.prepare import prepare
from endoprior.prepare.burnt_in_text import BurntInText, find_text
from endoprior.prepare.config import PrepareConfig
from endoprior.prepare.video_clip import StereoFrame

HEIGHT, WIDTH, COUNT = 192, 256, 12
CFG = PrepareConfig(depth="none", masks="none", poses="still")


def tissue():
    """Images of soft blobs that slide by several px from one to the next."""
    rng = np.random.default_rng(4)
    blobs = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT + 200, WIDTH + 200)), (0, 0), 8)
    levels = np.clip(120 + 30 * blobs / blobs.std(), 0, 255)
    for k in range(COUNT):
        part = levels[9 * k : 9 * k + HEIGHT, 11 * k : 11 * k + WIDTH]
        color = part[..., None] * [1.0, 0.5, 0.45] + rng.normal(0, 2, (HEIGHT, WIDTH, 3))
        yield np.clip(color, 0, 255).astype(np.uint8)


def written(frame, text, at):
    """The frame with white writing, and (H, W) where it is."""
    ink = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.putText(ink, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 255, 1, cv2.LINE_AA)
    share = ink[..., None] / 255
    return (frame * (1 - share) + 255 * share).astype(np.uint8), ink > 0


def prepared(tmp_path, frames, cfg=CFG):
    """The notes and the frames of what `prepare` makes of images."""
    (tmp_path / "video").mkdir(exist_ok=True)
    for k, frame in enumerate(frames):
        save_png(tmp_path / f"video/{k:04d}.png", frame)
    done = prepare(tmp_path / "video", tmp_path / "out", cfg)
    return [note for note in done.notes if "burnt-in text" in note], load_sequence(done.out)


def test_a_name_at_rest_is_black_and_masked_in_the_frames_that_show_it(tmp_path):
    frames, inks = list(tissue()), {}
    for k in range(5, COUNT):
        frames[k], inks[k] = written(frames[k], "SMITH, JOHN", (60, 140))
    (note,), sequence = prepared(tmp_path, frames)
    assert note.startswith("burnt-in text: text in 7 frames at ") and "(frame 5 first). " in note
    for k in range(COUNT):
        frame = sequence.frame(k)
        if k in inks:
            assert not frame.rgb_u8[inks[k]].any() and not frame.tissue_mask[inks[k]].any()
        assert frame.tissue_mask.mean() > (0.9 if k in inks else 0.9999)


def test_a_label_that_moves_is_black_and_masked_where_it_is(tmp_path):
    frames = [written(frame, f"polyp 0.9{k % 10}", (20 + 10 * k, 40 + 11 * k)) for k, frame in enumerate(tissue())]
    (note,), sequence = prepared(tmp_path, [frame for frame, _ in frames])
    assert note.startswith("burnt-in text: text that moves in 12 frames at ")
    for k, (_, ink) in enumerate(frames):
        frame = sequence.frame(k)
        assert not frame.tissue_mask[ink].any() and not frame.rgb_u8[ink].any() and frame.tissue_mask.mean() > 0.9


@pytest.mark.parametrize("cfg", [replace(CFG, blank=("50,120,140,30",)), replace(CFG, border="keep")])
def test_text_is_not_looked_for_where_it_is_painted_over_or_everything_is_kept(tmp_path, cfg):
    notes, sequence = prepared(tmp_path, [written(frame, "SMITH, JOHN", (60, 140))[0] for frame in tissue()], cfg)
    assert not notes and sequence.frame(0).tissue_mask.all() == (cfg.border == "keep")


def test_tissue_without_text_gives_no_note(tmp_path):
    notes, sequence = prepared(tmp_path, tissue())
    assert not notes and sequence.frame(3).tissue_mask.all()


def test_both_cameras_are_painted_at_one_place():
    text = BurntInText({7: [TextBox(0.9, 20.0, 10.0, 20.0, 8.0, 0.0)]})
    white = np.full((40, 60, 3), 255, np.uint8)
    seen = text.painted(StereoFrame(7, 0.0, white, white))
    assert seen.right is not None and not seen.left[8:13, 12:28].any() and not seen.right[8:13, 12:28].any()
    assert seen.left[20:].all() and white.all()
    other = StereoFrame(8, 0.0, white, None)
    assert text.painted(other) is other


def test_a_label_that_is_not_found_again_gives_no_note(monkeypatch):
    class OfSamples:
        """Finds a label that moves in the samples, and nothing when all frames are searched."""

        def find(self, image, scale=None):
            at = float(image[0, 0, 0])
            return [TextBox(0.95, at, at, 60.0, 10.0, 0.0)] if scale is None else []

    monkeypatch.setattr("endoprior.prepare.burnt_in_text.TextDetector", OfSamples)
    frames = [StereoFrame(k, k / 25, np.full((200, 200, 3), 40 + 20 * k, np.uint8), None) for k in range(6)]
    found = find_text(frames, lambda: frames, range(6), np.ones((200, 200), bool))
    assert not found.boxes and not found.notes
