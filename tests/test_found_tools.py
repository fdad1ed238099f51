"""What is recorded of found tools: rows of a folder, and `prepare` writes them, also if it was interrupted."""

import json

import cv2
import numpy as np
import pytest

from endoprior import tool_masks
from endoprior.core.checks import InputError
from endoprior.data import found_tools
from endoprior.data.found_tools import FoundTools, FrameRow
from endoprior.prepare import PrepareConfig, prepare
from endoprior.prepare.frame_tools import FOUND
from endoprior.tool_masks.network import small_view

ROWS = [FrameRow(i, 0.1, confidence) for i, confidence in enumerate((0.9, 0.2, 0.8, 0.4))]
NUM_FRAMES = 6


def test_rows_are_read_as_written_and_the_uncertain_named(tmp_path):
    assert found_tools.read_rows(tmp_path) == []
    found_tools.write_rows(tmp_path, ROWS)
    rows = found_tools.read_rows(tmp_path)
    assert rows == ROWS and found_tools.uncertain_frames(rows) == [1, 3]
    found_tools.drop_rows(tmp_path, [3, 7])
    assert found_tools.uncertain_frames(found_tools.read_rows(tmp_path)) == [1]


@pytest.mark.parametrize("text", ["{", "{}", "[3]", '[{"frame": -1, "share": 0, "confidence": 1}]', '[{"frame": 0}]'])
def test_a_damaged_file_is_one_line(tmp_path, text):
    (tmp_path / found_tools.FILE).write_text(text)
    with pytest.raises(InputError, match=r"tool_masks\.json: expected .*Fix: Remove the file") as error:
        found_tools.read_rows(tmp_path)
    assert "\n" not in str(error.value)


@pytest.fixture
def images(tmp_path):
    """A folder of frames, each with its number as the brightness of a corner."""
    folder = tmp_path / "images"
    folder.mkdir()
    rng = np.random.default_rng(0)
    tissue = np.clip(rng.normal((90, 80, 170), 12, (96, 128, 3)), 0, 255).astype(np.uint8)
    for i in range(NUM_FRAMES):
        image = tissue.copy()
        image[:16, :16] = 40 + 30 * i
        cv2.imwrite(str(folder / f"{i:03d}.png"), image)
    return folder


@pytest.fixture
def finder(monkeypatch):
    """Takes the place of our own: unsure in bright frames. Holds the frames that it was asked for."""
    asked = []

    class Finder:
        def find_over_time(self, images, view, each):
            small = np.zeros(small_view(view).shape, bool)
            small[:12, :48] = True
            for rgb_u8 in images:
                asked.append(rgb_u8)
                yield FoundTools(small, 1 - float(rgb_u8[4:12, 4:12].mean()) / 255)

    monkeypatch.setattr(tool_masks, "ToolFinder", Finder)
    return asked


CFG = PrepareConfig(layout="mono", border="keep", depth="none", poses="still")


def test_prepare_writes_the_confidence_of_each_frame_and_names_the_unsure(tmp_path, images, finder):
    done = prepare(images, tmp_path / "out", CFG)
    rows = json.loads((done.out / "tool_masks.json").read_text())
    assert [row["frame"] for row in rows] == list(range(NUM_FRAMES)) and not list(done.out.glob("*.jsonl"))
    assert np.allclose([row["confidence"] for row in rows], [1 - (40 + 30 * i) / 255 for i in range(NUM_FRAMES)])
    assert all(row["share"] == pytest.approx(8 * 32 / (96 * 128)) for row in rows)
    assert [note for note in done.notes if "unsure" in note] == [
        f"masks: unsure in frames 3-5. To look and correct: endoprior view {done.out}"
    ]
    assert len(finder) == NUM_FRAMES  # each once, though they are the samples of the first pass, too


def test_a_resumed_prepare_has_the_same_rows_and_does_not_search_again(tmp_path, images, finder):
    want = (prepare(images, tmp_path / "want", CFG).out / "tool_masks.json").read_bytes()

    def stop(what, done, total):
        if what == "writing frames" and done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(images, tmp_path / "out", CFG, stop)
    finder.clear()
    done = prepare(images, tmp_path / "out", CFG).out
    assert (done / "tool_masks.json").read_bytes() == want and not finder
    assert not (done / FOUND).exists()


def test_masks_that_are_not_found_have_no_confidence(tmp_path, images, finder):
    done = prepare(images, tmp_path / "out", PrepareConfig(**vars(CFG) | {"masks": "none"}))
    assert not list(done.out.glob("tool_masks*")) and not finder
