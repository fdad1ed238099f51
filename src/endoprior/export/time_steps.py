"""Which time steps of a scene to export, and the Gaussians of one of them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from ..core.checks import input_error, read_ranges
from ..core.config import DataConfig
from ..core.types import Camera, Splats
from ..data.sequence import Split, is_test_frame
from ..model.colors import one_color
from ..model.scene import Scene
from .axes import splats_in_axes
from .formats import Axes, ExportOptions


@dataclass(frozen=True)
class TimeStep:
    """The state of a scene at one time."""

    name: str
    """Of its files, without suffix: the frame's index, or the position in --times, in six digits."""
    time: float = 0.0
    """In [0, 1]."""
    frame: int | None = None
    """Index of the frame in the sequence, if it is one."""
    canonical: bool = False
    """The Gaussians as they are stored, before any motion; `time` is that of the first camera."""

    def splats(self, scene: Scene, axes: Axes) -> Splats:
        """The Gaussians, activated, in `axes`.

        Raises:
            InputError: the canonical state of several windows, each with Gaussians of its own.
        """
        if not self.canonical:
            return splats_in_axes(scene.at(self.time), axes)
        if len(scene.windows) > 1:
            fix = "choose a time with --times, or export one window: RUN/windows/000."
            raise input_error("--canonical", "a scene of one window", f"{len(scene.windows)} windows", fix)
        return splats_in_axes(scene.windows[0].scene.canonical(), axes)

    def plain_splats(self, scene: Scene, axes: Axes) -> Splats:
        """The Gaussians in `axes`, as other programs know them: one color each, fitted to what the camera sees."""
        return splats_in_axes(one_color(self.splats(scene, "opencv"), self.camera(scene)), axes)

    def camera(self, scene: Scene) -> Camera:
        """The sequence's camera at this time."""
        return scene.camera_at(self.time)

    def facts(self) -> dict[str, Any]:
        """What `index.json` says about it; the canonical state has no time."""
        return {"time": None if self.canonical else self.time} | ({} if self.frame is None else {"frame": self.frame})


def frame_indices(num_frames: int, split: Split, data: DataConfig) -> list[int]:
    """Ascending indices of the frames of a split, as `FrameSequence.indices` without a sequence.

    Args:
        data: how the sequence was read; its window and phase decide which frames were held out.
    Raises:
        InputError: the split is empty.
    """
    first = min(read_ranges("data.window", data.window), default=0)
    is_test = [is_test_frame(first + i, data.test_phase) for i in range(num_frames)]
    indices = [i for i in range(num_frames) if split == "video" or is_test[i] == (split == "test")]
    if not indices:
        raise input_error("--split", "a split with frames", f"{split}, which has none", "choose another.")
    return indices


def selected_time_steps(scene: Scene, options: ExportOptions) -> list[TimeStep]:
    """The time steps that `options` select: the canonical state, some times, or the frames of a split.

    Raises:
        InputError: `options` select in more than one way, or the split is empty.
    """
    if options.canonical + bool(options.times) + (options.split != "video") > 1:
        raise input_error("--canonical, --times, --split", "one of them", "several", "leave the others out.")
    if options.canonical:
        return [TimeStep("canonical", canonical=True)]
    if options.times:
        return [TimeStep(f"{k:06d}", time) for k, time in enumerate(options.times)]
    total = len(scene.cameras)
    return [TimeStep(f"{i:06d}", i / total, i) for i in frame_indices(total, options.split, scene.config.data)]


def seconds_of_motion(scene: Scene, steps: list[TimeStep]) -> list[float]:
    """Seconds from the first frame of the sequence to each of two or more time steps.

    Raises:
        InputError: there are fewer, or they do not increase.
    """
    seconds = [step.time * len(scene.cameras) / scene.frames_per_second for step in steps]
    if len(steps) < 2 or any(b <= a for a, b in pairwise(seconds)):
        got = ", ".join(f"{step.time:g}" for step in steps)
        raise input_error("--times, --split", "two or more increasing times", got, "list each time once, in order.")
    return seconds
