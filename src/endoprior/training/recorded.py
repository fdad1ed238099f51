"""Work on a device as a recording: launched as one CUDA graph, not as hundreds of kernels one after the other.

A recording reads the same memory each time, so a task is first laid on a desk: copied into tensors that stay where they
are. That is done even where nothing is recorded, and numbers become tensors all the same: a run gives the same bits
with recordings and without.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Protocol

import torch
from torch import Tensor

from ..core.types import Camera
from .frames import TENSORS, TrainingFrame
from .inspector import Evidence
from .state import TrainState
from .step import Task, Work

log = logging.getLogger(__name__)

WARM_UPS = 3
"""Times that a kind of task is done before it is recorded: libraries compile, choose and allocate at first."""
MOST_RECORDINGS = 16
"""At a time."""
SWITCH = "ENDOPRIOR_CUDA_GRAPHS"
"""Environment variable: 1 records, anything else does not."""


class Recording(Protocol):
    """One recorded iteration."""

    def __call__(self) -> Evidence:
        """Do it again, with what now lies on the desk; the evidence is overwritten by the next one."""


def recording_wanted() -> bool:
    """Whether the user asked for recordings."""
    return os.environ.get(SWITCH) == "1"


def kind_of(task: Task, min_depth_pixels: int) -> Hashable:
    """Equal for tasks that differ in nothing but numbers which lie on the desk."""
    views = [task.frame] if task.before is None else [task.frame, task.before]
    enough = task.frame.num_measured >= min_depth_pixels
    return (task.fine, task.sh_degree, enough, _room_key(task), tuple(_camera_key(view.camera) for view in views))


def _room_key(task: Task) -> Hashable:
    """Equal for tasks that fit into the same tensors."""
    shapes = (None if tensor is None else tuple(tensor.shape) for tensor in (task.frame.rgb_u8, task.prior))
    return (task.before is None, *shapes)


def _camera_key(camera: Camera) -> Hashable:
    numbers = tuple(getattr(camera, field.name) for field in fields(camera) if field.name != "world_to_camera")
    return numbers, camera.world_to_camera.tobytes()


class Desk:
    """Room for one task of each size, in tensors that stay where they are."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._rooms: dict[Hashable, dict[str, Tensor]] = {}

    def lay(self, task: Task) -> Task:
        """The task with every number that changes in a tensor on the device; one of its size at a time."""
        room = self._rooms.setdefault(_room_key(task), {})
        laid = replace(
            task, iteration=self._number(room, "iteration", task.iteration), frame=self._frame(room, "now", task.frame)
        )
        if task.before is not None:
            laid = replace(laid, before=self._frame(room, "before", task.before))
        if task.prior is not None:
            prior, mask = self._tensor(room, "prior", task.prior), self._tensor(room, "prior_mask", task.prior_mask)
            laid = replace(laid, prior=prior, prior_mask=mask)
        return laid

    def _frame(self, room: dict[str, Tensor], place: str, frame: TrainingFrame) -> TrainingFrame:
        tensors = {name: self._tensor(room, f"{place} {name}", getattr(frame, name)) for name in TENSORS}
        return replace(frame, time=self._number(room, f"{place} time", frame.time), **tensors)

    def _tensor(self, room: dict[str, Tensor], name: str, tensor: Tensor) -> Tensor:
        if name not in room:
            room[name] = torch.empty_like(tensor, device=self.device)
        return room[name].copy_(tensor, non_blocking=True)

    def _number(self, room: dict[str, Tensor], name: str, number: float) -> Tensor:
        if name not in room:
            room[name] = torch.zeros((), dtype=torch.float64, device=self.device)
        return room[name].fill_(number)


@dataclass
class _Known:
    """What is known of one kind of task."""

    done: int = 0
    recording: Recording | None = None


class Recorder:
    """`Work` on a device: each kind of task a few times as it is, then, if wanted, as a recording.

    The first recording of each kind is compared with the work itself, bit for bit, before it is trusted. If it differs,
    or cannot be made, a warning says so, and the run goes on without.
    """

    def __init__(
        self, work: Work, device: torch.device, record: Callable[[Callable[[], Evidence]], Recording] | None
    ) -> None:
        """Begin without recordings.

        Args:
            record: makes a recording of a call without doing it; None does without. Raises RuntimeError if it cannot.
        """
        self.work, self.record = work, record
        self._desk, self._stream = Desk(device), torch.cuda.Stream(device) if device.type == "cuda" else None
        self._known: dict[Hashable, _Known] = {}
        self._trusted: set[Hashable] = set()
        self._of: Tensor | None = None

    def __call__(self, state: TrainState, task: Task) -> Evidence:
        """See `Work`."""
        if state.gaussians["means"] is not self._of:  # other tensors in other places
            self.forget()
            self._of = state.gaussians["means"]
        kind = kind_of(task, self.work.cfg.loss.min_depth_pixels)
        known = self._known.setdefault(kind, _Known())
        with self._own_stream():
            place = self._desk.lay(task)
            known.done += 1
            if self._records(known):
                known.recording = self._recording(state, place)
                if known.recording and kind not in self._trusted:
                    self._trusted.add(kind)
                    return self._compared(state, place, known.recording)
            return known.recording().copied() if known.recording else self.work(state, place)

    def _records(self, known: _Known) -> bool:
        """Whether a kind of task is to be recorded now; of a moving camera there would be one for each frame."""
        wanted = self.record is not None and known.recording is None and known.done > WARM_UPS
        return wanted and sum(each.recording is not None for each in self._known.values()) < MOST_RECORDINGS

    def _recording(self, state: TrainState, place: Task) -> Recording | None:
        try:
            return self.record(lambda: self.work(state, place))
        except RuntimeError as error:
            state.optimizer.clear_gradients()  # nothing was computed, but they were put in place
            self._give_up(f"cannot be made: {' '.join(str(error).split())[:200]}")
            return None

    def _compared(self, state: TrainState, place: Task, recording: Recording) -> Evidence:
        """Do the task both ways from the same state; the work itself is what counts."""
        tensors = [*state.tensors(), self.work.inspector.frozen]
        before = [tensor.clone() for tensor in tensors]
        told = recording().copied()
        recorded = [tensor.clone() for tensor in tensors]
        for tensor, old in zip(tensors, before, strict=True):
            tensor.copy_(old)
        evidence = self.work(state, place)
        pairs = [*zip(tensors, recorded, strict=True), (evidence.losses.values, told.losses.values)]
        if not all(torch.equal(ours, theirs) for ours, theirs in pairs):
            self._give_up("differs from the work that it was made of")
        return evidence

    def _give_up(self, why: str) -> None:
        log.warning("a recording %s; training goes on without (%s)", why, SWITCH)
        self.record = None
        self.forget()

    def forget(self) -> None:
        """Drop all recordings: they hang on tensors that are no longer the state's."""
        self._known.clear()

    @contextmanager
    def _own_stream(self) -> Iterator[None]:
        """Queue on a stream of our own, after all that was queued before, and before all that will be.

        Recordings are made on a stream that is not the default one, and autograd accumulates gradients on the stream
        that met a tensor first.
        """
        if self._stream is None:
            yield
            return
        outside = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(outside)
        with torch.cuda.stream(self._stream):
            yield
        outside.wait_stream(self._stream)


class GraphRecorder:
    """Makes CUDA graphs that share their scratch memory: never two run at a time, and nobody keeps what they leave."""

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, call: Callable[[], Evidence]) -> Recording:
        """Record a call on the current stream, which must not be the default one."""
        graph = torch.cuda.CUDAGraph()
        # Not torch.cuda.graph(): it collects garbage and empties the allocator's cache first, at each recording.
        graph.capture_begin(pool=self._pool)
        try:
            evidence = call()
        finally:
            graph.capture_end()

        def replay() -> Evidence:
            graph.replay()
            return evidence

        return replay
