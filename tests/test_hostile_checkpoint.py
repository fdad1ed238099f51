"""Checkpoints from strangers: one line that names the file, and the trainer is left as it was."""

import numpy as np
import pytest
import torch
from conftest import write_tiny_sequence
from state_files import StateFile
from tiny_training import tiny_config

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.runs.folder import check_state, load_checkpoint
from endoprior.runs.train import train
from endoprior.training.gaussian_trainer import GaussianTrainer


def trained(folder, cfg):
    """A short training: what made it, and its checkpoint, as a file and taken apart."""
    sequence = load_sequence(write_tiny_sequence(folder / "data"))
    train(sequence, cfg, folder / "run")
    file = folder / "run" / "checkpoint.safetensors"
    return GaussianTrainer(sequence, cfg), file, StateFile.read(file)


@pytest.fixture(scope="module", params=["basis", pytest.param("hexplane", marks=pytest.mark.slow)])
def run(request, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("checkpoint"), tiny_config(request.param, coarse=2, fine=3))


def resume(run) -> GaussianTrainer:
    """A trainer that took over the checkpoint in the folder."""
    trainer, file, _ = run
    trainer.state = None
    try:
        load_checkpoint(trainer, file, trainer.sequence.fingerprint())
    except InputError:
        assert trainer.state is None
        raise
    return trainer


def test_every_flipped_bit_is_noticed(run, tmp_path):
    trainer, file, _ = run
    data, rng = file.read_bytes(), np.random.default_rng(0)
    damaged = tmp_path / "checkpoint.safetensors"
    for at in rng.integers(8 + int.from_bytes(data[:8], "little"), len(data), 30):
        damaged.write_bytes(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :])
        with pytest.raises(InputError, match=r"Fix: Train again without --resume\."):
            resume((trainer, damaged, None))
    assert resume(run).finished


def test_the_schema_is_what_a_checkpoint_holds(run):
    trainer, file, stored = run
    stored.write(file)
    assert resume(run).finished
    assert set(trainer.schema()) == set(stored.arrays)


def test_each_array_of_a_checkpoint_is_checked(run):
    _, file, stored = run
    for name, values in stored.arrays.items():
        wrong = "<i8" if values.dtype.kind == "f" else np.float32
        for changed in (None, values.astype(wrong), values[..., None], np.concatenate([values, values])):
            if changed is not None and changed.size == 0 == values.size and changed.dtype == values.dtype:
                continue
            arrays = {k: v for k, v in stored.arrays.items() if k != name}
            arrays |= {} if changed is None else {name: changed}
            StateFile(stored.about, arrays).write(file)
            with pytest.raises(InputError, match=r"checkpoint\.safetensors: expected"):
                resume(run)
        spoiled = {"f": np.nan, "i": -1, "u": 7}[values.dtype.kind]
        if values.size:
            arrays = stored.arrays | {name: values.copy()}
            arrays[name].flat[-1] = spoiled
            StateFile(stored.about, arrays).write(file)
            with pytest.raises(InputError, match=r"checkpoint\.safetensors: expected"):
                resume(run)


def test_facts_of_a_checkpoint_that_cannot_be(run):
    _, file, stored = run
    wrong = {
        "iteration": (-1, 4, "3", True, [[]]), "stage": (2, None, {}), "config": (None, {}), "fingerprint": (3,),
    }  # fmt: skip
    for name, values in wrong.items():
        without = {other: value for other, value in stored.about.items() if other != name}
        for about in (without, *(without | {name: value} for value in values)):
            StateFile(about, stored.arrays).write(file)
            with pytest.raises(InputError) as caught:
                resume(run)
            assert "checkpoint.safetensors: " in str(caught.value), about


def test_moments_and_counts_that_cannot_be(run):
    stored = run[2]
    arrays = {name: torch.from_numpy(value.copy()) for name, value in stored.arrays.items()}
    check_state(arrays, stored.about["iteration"])
    changes = {"optimizer.means.second": -1e-9, "optimizer.means.steps": 4, "stats.num_valid": -1}
    if "optimizer.plane_adam.marks" in arrays:
        changes |= {"optimizer.plane_adam.marks": 2, "optimizer.plane_adam.exp_avg_sq": -1}
    for name, value in changes.items():
        spoiled = arrays[name].clone()
        spoiled.view(-1)[0] = value
        with pytest.raises(InputError, match=name):
            check_state(arrays | {name: spoiled}, stored.about["iteration"])


def test_tracks_of_another_sequence(tmp_path):
    """Tracks of fewer frames than the sequence has are named; those of all of them are taken over."""
    cfg = tiny_config("basis", coarse=0, fine=1).replace({"init.motion": "flow", "loss.track_weight": 0.01})
    taken = trainer, file, stored = trained(tmp_path, cfg)
    assert resume(taken).state.tracks.followed.shape[0] == len(trainer.sequence.indices("train"))
    fewer = {name: stored.arrays[name][1:] for name in ("tracks.displacement", "tracks.followed")}
    StateFile(stored.about, stored.arrays | fewer).write(file)
    with pytest.raises(InputError, match=r"training frames in tracks\.displacement"):
        resume(taken)
