"""Recorded iterations, without a GPU: a tape of every operation stands for the graph, and replays them blindly.

As a graph does, the tape knows addresses and constants but no Python: a number that went into an operation when it was
recorded goes in again, and a tensor from outside is read as it is then.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_device_loop import quiet, state_of
from test_train import tiny_config
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

from endoprior.compute.compiled import definitions_only
from endoprior.core.types import RenderOutput
from endoprior.data import load_sequence
from endoprior.training import recorded
from endoprior.training.recorded import WARM_UPS
from endoprior.training.step import Work
from endoprior.training.trainer import Trainer

KINDS = ("basis", "hexplane")


class Tape(TorchDispatchMode):
    """Records operations while they run."""

    def __init__(self):
        super().__init__()
        self.operations, self._names, self._kept = [], {}, []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        noted = tree_map(self._name, (args, kwargs))
        out = function(*args, **kwargs)
        self.operations.append((function, noted, tree_map(self._give_name, out)))
        return out

    def _name(self, value):
        return (
            ("made", self._names[id(value)]) if isinstance(value, torch.Tensor) and id(value) in self._names else value
        )

    def _give_name(self, value):
        if not isinstance(value, torch.Tensor) or id(value) in self._names:
            return ("made", self._names[id(value)]) if isinstance(value, torch.Tensor) else None
        self._names[id(value)] = len(self._kept)
        self._kept.append(value)  # and its address is not given to another
        return ("made", len(self._kept) - 1)

    def replay(self):
        """Do everything again; what was made then is overwritten with what is made now."""
        made = {}

        def found(value):
            return made[value[1]] if isinstance(value, tuple) and value[:1] == ("made",) else value

        def is_name(value):
            return isinstance(value, tuple) and value[:1] == ("made",)

        for function, (args, kwargs), names in self.operations:
            out = function(*tree_map(found, args, is_leaf=is_name), **tree_map(found, kwargs, is_leaf=is_name))
            for name, value in zip(_leaves(names), _leaves(out), strict=True):
                if is_name(name):
                    made[name[1]] = value
        for number, value in made.items():
            kept = self._kept[number].detach()
            if 0 not in kept.stride():  # an expanded one has the memory of another
                kept.copy_(value.detach())


def _leaves(value):
    if isinstance(value, list) or (isinstance(value, tuple) and value[:1] != ("made",)):
        return [leaf for part in value for leaf in _leaves(part)]
    return [value]


class TapeRecorder:
    """In the place of `GraphRecorder`. Recording must not do anything, so what it did is undone."""

    def __init__(self, state_tensors):
        self.state_tensors, self.made, self.replayed = state_tensors, 0, 0

    def __call__(self, call):
        before = [tensor.detach().clone() for tensor in self.state_tensors()]
        tape = Tape()
        with tape:
            evidence = call()
        for tensor, old in zip(self.state_tensors(), before, strict=True):
            tensor.detach().copy_(old)
        self.made += 1

        def again():
            self.replayed += 1
            with torch.no_grad():
                tape.replay()
            return evidence

        return again


def soft_picture(splats, camera, *, background, depth_grad_to_means=True):
    """A rasterizer of fixed shapes in plain torch: order plays no part, everything has a gradient."""
    view = torch.as_tensor(camera.world_to_camera, dtype=torch.float32)
    x, y, z = (splats.means @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    rows, columns = torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5
    spread = splats.scales.mean(-1) * camera.fx / z + 1 + 0.01 * splats.quats[:, 0].square()
    far = ((columns[None, :, None] - means2d[:, 0]) ** 2 + (rows[:, None, None] - means2d[:, 1]) ** 2) / spread**2
    weights = splats.opacities * (-0.5 * far).exp()
    total = weights.sum(-1)
    color = weights @ (splats.sh.sum(1) * 0.28 + 0.5) / (1 + total[..., None]) + background
    return RenderOutput(color, total / (1 + total), weights @ z / (1 + total), means2d, (3 * spread).int())


def started(folder, cfg, record):
    trainer = Trainer(load_sequence(folder), cfg)
    trainer._work.work.rasterize = soft_picture
    trainer.start()
    recorder = TapeRecorder(lambda: [*trainer.state.tensors(), trainer._inspector.frozen])
    trainer._work.record = recorder if record else None
    return trainer, recorder


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("both", [False, True])
def test_a_recording_does_what_the_work_does(tiny_sequence, kind, both):
    """Bit for bit: times, rates, counts, frames and choices come from the desk and the device, none from Python."""
    cfg = quiet(tiny_config(kind, coarse=6, fine=45))
    ends = {"gradient": "both", "valid_at_both": True} if both else {"max_points": 64}
    cfg = replace(cfg, temporal=replace(cfg.temporal, **ends))
    cfg = replace(cfg, schedule=replace(cfg.schedule, half_resolution_iterations=15))
    runs = []
    with definitions_only():
        for record in (False, True):
            trainer, recorder = started(tiny_sequence, cfg, record)
            rows = []
            while not trainer.finished:
                rows.append(trainer.step().terms)
            runs.append((rows, state_of(trainer)))
    assert recorder.made >= 3 and recorder.replayed >= 20
    assert any("distance" in row for row in runs[0][0])
    assert runs[0][0] == runs[1][0]
    assert all(torch.equal(runs[0][1][name], value) for name, value in runs[1][1].items())


def test_a_number_from_python_is_noticed(tiny_sequence, monkeypatch):
    """That the test above can fail: a learning rate that stays what it was when it was recorded."""
    cfg, original = quiet(tiny_config("basis", coarse=0, fine=25)), Work.__call__
    monkeypatch.setattr(Work, "__call__", lambda self, s, t: original(self, s, replace(t, iteration=int(t.iteration))))
    with definitions_only():
        states = []
        for record in (False, True):
            trainer, _ = started(tiny_sequence, cfg, record)
            while not trainer.finished:
                trainer.step()
            states.append(state_of(trainer))
    assert not all(torch.equal(states[0][name], value) for name, value in states[1].items())


def test_recordings_are_dropped_when_the_crowd_changes(tiny_sequence):
    cfg = tiny_config("basis", coarse=0, fine=30)
    cfg = replace(cfg, density=replace(cfg.density, every=10), temporal=replace(cfg.temporal, weight=0.0))
    with definitions_only():
        trainer, recorder = started(tiny_sequence, cfg, True)
        sizes = set()
        while not trainer.finished:
            sizes.add(trainer.step().num_gaussians)
    assert len(sizes) > 1 and recorder.made >= 2
    assert recorder.replayed < 30 - WARM_UPS


def test_the_desk_tells_kinds_apart(tiny_sequence):
    with definitions_only():
        trainer, _ = started(tiny_sequence, tiny_config("basis"), False)
        first, second = trainer._task(1, 0), trainer._task(1, 1)
    kind = recorded.kind_of
    assert kind(first, 10) == kind(second, 10)
    moved = replace(first.frame, camera=replace(first.frame.camera, fx=first.frame.camera.fx + 1))
    others = [replace(first, frame=moved), replace(first, before=first.frame), replace(first, sh_degree=1)]
    others.append(replace(first, prior=None, prior_mask=None))
    assert len({kind(task, 10) for task in [first, *others]}) == 5
    assert kind(first, 10**9) != kind(first, 10)


def test_recording_is_asked_for(monkeypatch):
    monkeypatch.delenv(recorded.SWITCH, raising=False)
    assert not recorded.recording_wanted()
    monkeypatch.setenv(recorded.SWITCH, "1")
    assert recorded.recording_wanted()


def test_a_moving_camera_takes_no_more_room(tiny_sequence, monkeypatch):
    """The same tensors for all cameras, and not a recording for each of many."""
    cfg = quiet(tiny_config("basis", coarse=0, fine=60))
    monkeypatch.setattr(recorded, "MOST_RECORDINGS", 2)
    with definitions_only():
        trainer, recorder = started(tiny_sequence, replace(cfg, temporal=replace(cfg.temporal, weight=0.0)), True)
        original = trainer._task

        def moving(iteration, position):
            task = original(iteration, position)
            pose = task.frame.camera.world_to_camera.copy()
            pose[0, 3] += 0.01 * position
            return replace(task, frame=replace(task.frame, camera=replace(task.frame.camera, world_to_camera=pose)))

        trainer._task = moving
        while not trainer.finished:
            trainer.step()
    assert recorder.made == 2 and len(trainer._work._known) > 4
    assert len(trainer._work._desk._rooms) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fault", ["differs", "cannot be made"])
def test_a_bad_recording_is_noticed_and_changes_nothing(tiny_sequence, kind, fault, caplog):
    cfg, states = quiet(tiny_config(kind, coarse=0, fine=20)), []
    with definitions_only():
        for bad in (False, True):
            trainer, recorder = started(tiny_sequence, cfg, bad)

            def record(call, trainer=trainer, recorder=recorder):
                recording = recorder(call)
                if fault == "cannot be made":
                    raise RuntimeError("operation not permitted\nwhen stream is capturing")

                def wrong():
                    evidence = recording()
                    trainer.state.stats.num_seen += 1
                    return evidence

                return wrong

            trainer._work.record = record if bad else None
            while not trainer.finished:
                trainer.step()
            states.append(state_of(trainer))
    assert recorder.made == 1 and fault in caplog.text and trainer._work.record is None
    assert all(torch.equal(states[0][name], value) for name, value in states[1].items())
