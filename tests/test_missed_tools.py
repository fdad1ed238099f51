"""Tools that a found mask misses do not count in training: the decision by itself, and in a run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_training import tiny_config

from endoprior.core.config_io import from_dict, to_dict
from endoprior.data import load_sequence
from endoprior.data.edit import note_found_masks
from endoprior.data.images import read_tool_mask, save_png
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.missed_tools import MissedToolFinder, missed_tools

VIEW = np.ones((128, 160), bool)
NOWHERE = np.zeros_like(VIEW)
SHAFT = np.s_[56:72, :90]


def scene():
    """(rendered, frame): a frame with a gray shaft from the left that the rendered image lacks; noise elsewhere."""
    rng = np.random.default_rng(0)
    rendered = np.full((128, 160, 3), (0.5, 0.25, 0.25), np.float32) + rng.normal(0, 0.02, (128, 160, 1))
    frame = rendered + rng.normal(0, 0.01, (128, 160, 3))
    frame[SHAFT] = 0.42
    return rendered.astype(np.float32), frame.astype(np.float32)


def shaft():
    mask = np.zeros_like(VIEW)
    mask[SHAFT] = True
    return mask


def test_a_tool_that_the_mask_lacks_is_found():
    found = missed_tools(*scene(), VIEW, VIEW, NOWHERE)
    assert (found & shaft()).sum() > 0.9 * shaft().sum() and (found & ~shaft()).sum() < 0.8 * shaft().sum()


def test_the_missed_end_of_a_masked_tool_is_found_and_nothing_of_the_mask():
    masked = shaft()
    masked[:, 50:] = False
    found = missed_tools(*scene(), ~masked, VIEW, NOWHERE)
    rest = shaft() & ~masked
    assert (found & rest).sum() > 0.8 * rest.sum() and not (found & masked).any()


@pytest.mark.parametrize(
    "why", ["explained", "tissue color", "no contact", "highlight", "outside the view", "no tissue"]
)
def test_other_errors_count(why):
    rendered, frame = scene()
    tissue, view, surely_tissue = VIEW, VIEW, NOWHERE
    if why == "explained":
        rendered[SHAFT] = frame[SHAFT]
    elif why == "tissue color":
        surely_tissue = VIEW
    elif why == "no contact":  # it does not enter from the border
        rendered, frame = (np.roll(image, 35, 1) for image in (rendered, frame))
    elif why == "highlight":
        frame[SHAFT] = rendered[SHAFT]
        frame[60:65, :40] = 0.95
    elif why == "outside the view":
        view = VIEW.copy()
        view[:, :95] = False
        tissue = view
    else:
        tissue = NOWHERE
    assert not missed_tools(rendered, frame, tissue, view, surely_tissue).any()


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """(folder with true masks, folder whose masks were found and are empty in frame 3)."""
    true = tmp_path_factory.mktemp("doubt") / "true"
    write_phantom(true, PhantomConfig(frames=9, width=160, height=128, seed=4))
    described = json.loads((true / "sequence.json").read_text())
    (true / "sequence.json").write_text(json.dumps(described | {"sources": {"depth": "known"}}))
    found = true.with_name("found")
    shutil.copytree(true, found)
    save_png(found / "masks" / "000003.png", np.zeros((128, 160), np.uint8))
    note_found_masks(found, 8 / 9)
    return true, found


def test_found_masks_are_noted_beside_what_was_there(phantom):
    true, found = (json.loads((folder / "sequence.json").read_text()) for folder in phantom)
    assert found.pop("sources") == true.pop("sources") | {"masks": "tools found in 89% of the frames"}
    assert found == true
    assert [load_sequence(folder).masks_are_found for folder in phantom] == [False, True]


def test_pixels_of_a_missed_tool_do_not_count(phantom):
    sequence = load_sequence(phantom[1]).training_view()
    frame = GaussianTrainer(sequence, tiny_config("basis")).step_once.frames.frame(2)  # frame 1 is held out
    tool = torch.from_numpy(read_tool_mask(phantom[0] / "masks" / "000003.png"))
    assert frame.index == 3 and tool.any()
    color = torch.where(tool[..., None], torch.tensor([0.5, 0.2, 0.2]), frame.rgb)
    counted = MissedToolFinder(sequence).without_tools(frame, color)
    missed = frame.tissue_mask & ~counted.tissue_mask
    assert (missed & tool).sum() > 0.5 * tool.sum() and (missed & ~tool).sum() < 0.6 * tool.sum()
    assert counted.num_measured == counted.measured.sum() < frame.num_measured
    assert MissedToolFinder(sequence).without_tools(frame, frame.rgb) is frame


def test_frames_of_half_and_full_resolution_share_what_is_surely_tissue(make_tiny_sequence):
    data = make_tiny_sequence(num_frames=3, width=328, height=213)  # 104 and 103 rows of 160 px
    sequence = load_sequence(data).training_view()
    frames, finder = GaussianTrainer(sequence, tiny_config("basis")).step_once.frames, MissedToolFinder(sequence)
    for half in (True, False):
        frame = frames.frame(0, half=half)
        assert finder.without_tools(frame, frame.rgb) is frame


@pytest.mark.parametrize(("which", "trust", "finds"), [(1, False, True), (1, True, False), (0, False, False)])
def test_only_found_masks_that_are_not_trusted_are_searched(phantom, which, trust, finds):
    cfg = tiny_config("basis").replace({"trust_masks": trust})
    trainer = GaussianTrainer(load_sequence(Path(phantom[which])), cfg)
    assert (trainer.step_once.missed_tools is not None) == finds
    assert from_dict(type(cfg), to_dict(cfg)).loss.trust_masks == trust


def test_the_search_begins_when_the_scene_explains_resting_tissue(phantom, monkeypatch):
    calls = []
    monkeypatch.setattr(
        MissedToolFinder, "without_tools", lambda self, frame, color: calls.append(color.shape) or frame
    )
    cfg = tiny_config("basis", coarse=2, fine=20).replace({"trust_masks": False})
    trainer = GaussianTrainer(load_sequence(phantom[1]).training_view(), cfg)
    trainer.start()
    trainer.run([])
    assert len(calls) == 18
    longer = GaussianTrainer(trainer.sequence, cfg.extended(1000))  # a tenth of it is not done yet
    state = trainer.state
    arrays = state.arrays()
    for shown, more in ((0.0, 0), (0.1, 1)):  # once begun, it goes on when the run is extended
        shares = torch.full_like(arrays["left_out"], shown)
        longer.restore(state.stage, state.iteration, arrays | {"left_out": shares})
        calls.clear()
        longer.step()
        assert len(calls) == more
