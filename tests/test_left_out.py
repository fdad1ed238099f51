"""Training says in which frames it met tools that the masks miss: what it keeps, what a run records, what it prints."""

import json
from dataclasses import replace

import pytest
import torch
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.edit import note_found_masks
from endoprior.runs.folder import CONFIG, LOG, check_state, load_checkpoint, save_checkpoint
from endoprior.runs.log import missed_tools_line, missed_tools_of
from endoprior.runs.train import train
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.missed_tools import (
    MIN_MISSED_TOOL_SHARE,
    VISITS,
    MissedToolFinder,
    missed_tool_frames,
    record_visit,
)

MISSED = 4


def test_only_the_last_visits_count_and_one_of_them_is_not_enough():
    shares, much = torch.zeros(3, VISITS), 2 * MIN_MISSED_TOOL_SHARE
    for _ in range(VISITS):
        record_visit(shares, 0, much)  # early, then explained
    for share in (0.0, 0.0, 0.0, much):
        record_visit(shares, 0, share)
    for share in (much, MIN_MISSED_TOOL_SHARE / 2, much, 0.0):
        record_visit(shares, 1, share)
    record_visit(shares, 2, much)
    expected = [much, MIN_MISSED_TOOL_SHARE / 2, much, 0.0]
    assert shares.shape == (3, VISITS) and shares[1].tolist() == pytest.approx(expected)
    assert missed_tool_frames(shares, [0, 2, 5]) == (2,)


@pytest.fixture
def sequence(make_tiny_sequence, monkeypatch):
    """A sequence with found masks; a fifth of the rows of one frame never counts, as if a tool was missed there."""
    folder = make_tiny_sequence(num_frames=6)
    note_found_masks(folder, 0.5)

    def counted(self, frame, color):
        keep = torch.ones_like(frame.tissue_mask)
        keep[: len(keep) // 5] = frame.index != MISSED
        return replace(frame, tissue_mask=frame.tissue_mask & keep) if frame.index == MISSED else frame

    monkeypatch.setattr(MissedToolFinder, "without_tools", counted)
    return load_sequence(folder)


CFG = tiny_config("basis", coarse=1, fine=25).replace({"trust_masks": False})


@pytest.mark.slow
def test_a_run_records_the_frames_and_names_them_with_the_command(sequence, tmp_path):
    run = tmp_path / "run"
    train(sequence, CFG, run, progress=False)
    last = json.loads((run / LOG).read_text().splitlines()[-1])
    assert last["iteration"] == 25 and last["missed_tool_frames"] == [MISSED]
    assert missed_tools_of(run) == [MISSED]
    line = missed_tools_line(run, sequence.path)
    assert (
        line.startswith(f"Tools are likely missed in frame {MISSED}. ") and f"`endoprior view {sequence.path}`" in line
    )
    assert len(line.splitlines()) == 1
    assert main(["eval", str(run), "--no-networks"]) == 0
    assert json.loads((run / "metrics.json").read_text())["protocol"]["missed_tool_frames"] == [MISSED]
    with open(run / LOG, "a", encoding="utf-8") as lines:  # of an extended run the last line counts
        lines.write(json.dumps(last | {"iteration": 30, "missed_tool_frames": []}) + "\n")
    assert missed_tools_of(run) == []


def test_a_resumed_training_has_the_same_shares(sequence, tmp_path):
    trainer, again = (GaussianTrainer(sequence, CFG) for _ in range(2))
    trainer.start()
    for _ in range(15):
        trainer.step()
    assert trainer.state.left_out.max() > 0.1 and trainer.state.left_out.shape == (5, VISITS)
    save_checkpoint(trainer, tmp_path / "state", "0")
    load_checkpoint(again, tmp_path / "state", "0")
    assert torch.equal(trainer.state.left_out, again.state.left_out)
    for _ in range(11):
        one, other = trainer.step(), again.step()
    assert torch.equal(trainer.state.left_out, again.state.left_out)
    assert one.missed_tool_frames == other.missed_tool_frames == (MISSED,) and trainer.finished
    with pytest.raises(InputError, match="expected shares in left_out"):
        check_state({"left_out": torch.tensor([[2.0] * VISITS])}, 1)


def test_trusted_masks_miss_nothing(sequence, tmp_path):
    run = tmp_path / "run"
    train(sequence, CFG.replace({"trust_masks": True, "schedule.fine_iterations": 2}), run, progress=False)
    assert missed_tools_of(run) is None and missed_tools_line(run, sequence.path) == ""


def test_windows_count_from_the_start_of_the_sequence(tmp_path):
    assert missed_tools_of(tmp_path) is None
    (tmp_path / CONFIG).write_text(json.dumps({"windows": [[0, 12], [10, 20]]}))
    lines = [{"window": 0, "iteration": 1}, *({"window": k, "missed_tool_frames": [0, 10]} for k in (0, 1))]
    (tmp_path / LOG).write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"window"')
    assert missed_tools_of(tmp_path) == [0, 10, 20]


def test_the_share_is_of_the_view(sequence):
    frame = GaussianTrainer(sequence, CFG).step_once.frames.frame(0)
    finder = MissedToolFinder(sequence)
    half = torch.zeros_like(frame.tissue_mask)
    half[: len(half) // 2] = True
    counted = replace(frame, tissue_mask=frame.tissue_mask & ~half)
    lost = int((frame.tissue_mask & half).sum())
    assert finder.share(frame, frame) == 0
    # The whole image is the view: nothing is black or masked in all frames.
    assert finder.share(frame, counted) == pytest.approx(lost / half.numel()) and lost
