"""Work on a device as a recording: launched as one CUDA graph, not as hundreds of kernels one after the other.

A recording reads the same memory each time, so a task is first laid on a desk: copied into tensors that stay where they
are. That is done even where nothing is recorded, and numbers become tensors all the same: a run gives the same bits
with recordings and without.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Protocol

import torch
from torch import Tensor

from .inspector import Evidence
from .iteration import Task, Work
from .train_state import TrainState
from .training_frames import TENSORS, TrainingFrame
from .types import Camera

WARM_UPS = 3
"""Times that a kind of task is done before it is recorded: libraries compile, choose and allocate at first."""
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
    return (
        task.fine, task.sh_degree, task.before is None, task.frame.num_measured >= min_depth_pixels,
        tuple(_shape(t) for t in (task.frame.rgb_u8, task.prior)), tuple(_camera_key(view.camera) for view in views),
    )  # fmt: skip


def _shape(tensor: Tensor | None) -> tuple[int, ...] | None:
    return None if tensor is None else tuple(tensor.shape)


def _camera_key(camera: Camera) -> Hashable:
    numbers = tuple(getattr(camera, field.name) for field in fields(camera) if field.name != "world_to_camera")
    return numbers, camera.world_to_camera.tobytes()


class Desk:
    """Room for one task of each kind, in tensors that stay where they are."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._places: dict[Hashable, Task] = {}

    def lay(self, task: Task, kind: Hashable) -> Task:
        """The task with every number that changes in a tensor on the device; one of its kind at a time."""
        if kind not in self._places:
            self._places[kind] = self._room(task)
        place = self._places[kind]
        place.iteration.fill_(task.iteration)
        _copy_frame(task.frame, place.frame)
        if task.before is not None:
            _copy_frame(task.before, place.before)
        if task.prior is not None:
            place.prior.copy_(task.prior, non_blocking=True)
            place.prior_mask.copy_(task.prior_mask, non_blocking=True)
        return place

    def _room(self, task: Task) -> Task:
        return replace(
            task,
            iteration=self._number(),
            frame=self._frame(task.frame),
            before=task.before and self._frame(task.before),
            prior=None if task.prior is None else torch.empty_like(task.prior, device=self.device),
            prior_mask=None if task.prior is None else torch.empty_like(task.prior_mask, device=self.device),
        )

    def _frame(self, frame: TrainingFrame) -> TrainingFrame:
        tensors = {name: torch.empty_like(getattr(frame, name), device=self.device) for name in TENSORS}
        return replace(frame, time=self._number(), **tensors)

    def _number(self) -> Tensor:
        return torch.zeros((), dtype=torch.float64, device=self.device)


def _copy_frame(frame: TrainingFrame, place: TrainingFrame) -> None:
    place.time.fill_(frame.time)
    for name in TENSORS:
        getattr(place, name).copy_(getattr(frame, name), non_blocking=True)


@dataclass
class _Known:
    """What is known of one kind of task."""

    done: int = 0
    recording: Recording | None = None


class Recorder:
    """`Work` on a device: each kind of task a few times as it is, then, if wanted, as a recording."""

    def __init__(
        self, work: Work, device: torch.device, record: Callable[[Callable[[], Evidence]], Recording] | None
    ) -> None:
        """Begin without recordings.

        Args:
            record: makes a recording of a call without doing it; None does without.
        """
        self.work, self.record = work, record
        self._desk, self._stream = Desk(device), torch.cuda.Stream(device) if device.type == "cuda" else None
        self._known: dict[Hashable, _Known] = {}
        self._of: Tensor | None = None

    def __call__(self, state: TrainState, task: Task) -> Evidence:
        """See `Work`."""
        if state.gaussians["means"] is not self._of:  # other tensors in other places
            self.forget()
            self._of = state.gaussians["means"]
        kind = kind_of(task, self.work.cfg.loss.min_depth_pixels)
        known = self._known.setdefault(kind, _Known())
        with self._own_stream():
            place = self._desk.lay(task, kind)
            if known.recording is None and self.record is not None and known.done >= WARM_UPS:
                known.recording = self.record(lambda: self.work(state, place))
            known.done += 1
            return known.recording().copied() if known.recording else self.work(state, place)

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
