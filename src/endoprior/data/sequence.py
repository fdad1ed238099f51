"""A sequence of frames that are read when first used, its parts, and its split into training and test frames.

`T` frames; every 8th frame is a test frame, starting at frame 1, or later with another `test_phase`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error, number_ranges
from ..core.config import DataConfig
from ..core.types import Camera, Fingerprints, Frame
from ..system.memory import BoundedCache, cache_bytes, workers
from .description import ESTIMATED_POSES, TOOLS_FOUND
from .files import demand_same, digests_of, fingerprint_of, state_of
from .pixels import weighted
from .right_camera import right_frame
from .scale import Scale
from .trainable import demand_trainable, frame_contents
from .truth import RightEye, Truth

Split = Literal["train", "test", "video"]
TEST_EVERY = 8
DECODING_BYTES = 40  # memory per pixel while a frame is read
TOOL_FRACTION_WARNING = 0.6  # with a larger share of tool pixels, the mask is probably inverted


def is_test_frame(index: int, phase: int = 0) -> bool:
    """Whether a frame is held out: indices 1, 9, 17, ... and `phase` frames later; phase 7 has 0, 8, 16, ..."""
    return (index - 1) % TEST_EVERY == phase


class FrameSpan(Protocol):
    """Some successive frames: a window of a scene, for example."""

    @property
    def start(self) -> int: ...
    @property
    def stop(self) -> int: ...


@dataclass(frozen=True)
class FrameSummaries:
    """What the frames show, in short, for the plan of windows; `T` frames."""

    thumbnails: NDArray[np.float32]  # (T, h, w, 3) color in [0, 1]
    depth_mm: NDArray[np.float64]  # (T,) median of the measured depth; NaN without


@dataclass(eq=False, repr=False)
class FrameSequence:
    """Frames of one scene, decoded when they are used; a cache keeps as many as memory allows, 1 MB per 110,000 px."""

    path: Path
    """Folder of the sequence, for messages."""
    _cameras: list[Camera]
    _read_frame: Callable[[int], Frame]
    """Decodes frame i; called again if the frame is no longer in the cache."""
    _: KW_ONLY
    frames_per_second: float | None = None
    """Of the video, None if unknown."""
    image_files: list[Path] = field(default_factory=list)
    """The color image of each frame; empty if frames are not files of their own."""
    files: list[Path] = field(default_factory=list)
    """Every file that makes up the sequence."""
    truth: Truth | None = None
    """Ground truth of a synthetic sequence."""
    right_eye: RightEye | None = None
    """Pictures of the right camera, to score against."""
    remarks: list[str] = field(default_factory=list)
    """What is unusual but usable, one line each."""
    mask_name: str = "masks"
    """Name of the folder of the masks; another than `masks` or `gt_masks` where the layout has none."""
    mask_files: list[Path] = field(default_factory=list)
    """The PNG of each frame's mask at the size of the frame; empty if there are no such files."""
    new_mask_files: list[Path] = field(default_factory=list)
    """Where there are none: the PNG of each frame that becomes its mask if all of them are made."""
    mask_tool_value: int = 255
    """Value of tools in these files, 255 or 0."""
    depth_is_relative: bool = False
    """The scale of depth is unknown or assumed, so that lengths are not in mm."""
    scale: Scale | None = None
    """How relative depth was brought to mm; None if it was measured in mm, or is relative."""
    sources: dict[str, str] = field(default_factory=dict)
    """Origin of each part, such as {"depth": "stereo"}."""
    frame_weights: NDArray[np.float64] | None = None
    """(T,) in [0, 1]: how far each frame is to be believed. One of weight 0, such as without a camera pose, is neither
    trained on nor scored. None: all alike (`data.reliability ignored`)."""
    layout: str = ""
    """Name of the layout of its folder, as `load_sequence` recognized it or was told; empty otherwise."""
    reading: DataConfig | None = None
    """How `load_sequence` read it; None for a sequence that was made in another way."""
    read_again: Callable[[DataConfig], FrameSequence] | None = None
    """Reads the whole sequence in another way; None for a part or a changed one, which would be lost."""
    summaries: FrameSummaries | None = None
    """What `window_plan.summarize_frames` found; None before."""

    def __post_init__(self) -> None:
        self._states = [state_of(file) for file in self.files]
        self._cache: BoundedCache[Frame] = BoundedCache(cache_bytes(), _frame_bytes)
        self._holds_out, self._first, self._test_phase = False, 0, 0

    @property
    def image_names(self) -> list[str]:
        """Name of each frame's color image, without its suffix; empty if frames are not files of their own."""
        return [file.stem for file in self.image_files]

    @property
    def masks_are_found(self) -> bool:
        """Whether a program found the tools, rather than a person."""
        return TOOLS_FOUND in self.sources.get("masks", "")

    @property
    def depth_is_guessed(self) -> bool:
        """Whether depth is a guess from one camera, in a unit or not: its shape was not measured."""
        return self.depth_is_relative or self.scale is not None

    @property
    def poses_are_estimated(self) -> bool:
        """Whether a program found the camera's path in the video."""
        return self.sources.get("poses") in ESTIMATED_POSES

    @property
    def takes_masks(self) -> bool:
        """Whether the layout has a folder of masks, so that masks that are painted there are read."""
        return self.mask_name in ("masks", "gt_masks")

    @property
    def mask_folder(self) -> str:
        """Name of the folder of the masks that are read; empty where the layout has none, or it is missing."""
        return self.mask_name if self.takes_masks and (self.path / self.mask_name).is_dir() else ""

    def __len__(self) -> int:
        return len(self._cameras)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> FrameList: ...
    def __getitem__(self, index: int | slice) -> Frame | FrameList:
        """Frame `index` (negative: from the end), or the list of a slice of frames, decoded when they are used."""
        return self.frames("video")[index]

    def __iter__(self) -> Iterator[Frame]:
        """All frames in order, decoded one by one."""
        return iter(self.frames("video"))

    def __repr__(self) -> str:
        size = f"{self.camera(0).width}x{self.camera(0).height}" if len(self) else "no frames"
        rate = f", {self.frames_per_second:g} frames per second" if self.frames_per_second else ""
        split = ", ".join(f"{len(self.indices(split))} {split}" for split in ("train", "test"))
        depth = "relative" if self.depth_is_relative else "mm"
        return f"FrameSequence({str(self.path)!r}: {len(self)} frames ({split}), {size}{rate}, depth in {depth})"

    def camera(self, index: int) -> Camera:
        """The camera of frame `index`."""
        return self._cameras[index]

    def frame(self, index: int) -> Frame:
        """Frame `index`, counted over the whole sequence from 0.

        Raises:
            IndexError: no such frame.
            InputError: one of its files cannot be used.
            ValueError: it is a test frame, and this is a `training_view`.
        """
        if self._holds_out and self._is_test(index):
            raise ValueError(f"frame must be a training frame; got {index}, which is held out")
        return self._decoded(index)

    def _decoded(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"frame must be in 0..{len(self) - 1}; got {index}")
        return self._cache.get(index, lambda: self._believed(index))

    def _believed(self, index: int) -> Frame:
        frame = self._read_frame(index)
        return frame if self.frame_weights is None else weighted(frame, float(self.frame_weights[index]))

    def frames(self, split: Split) -> FrameList:
        """The frames of a split, decoded one by one as they are used."""
        return FrameList(self, self.indices(split))

    def right_frame(self, index: int) -> Frame:
        """Frame `index` as the right eye sees it: tissue is what both eyes see. There must be a right eye."""
        if self.right_eye is None:
            raise ValueError("a right frame needs a sequence with a right eye")
        return right_frame(self.frame(index), self.right_eye.image(index), self.right_eye.baseline_mm)

    def indices(self, split: Split) -> list[int]:
        """Ascending frame indices: `test` has (i - 1) % 8 == `test_phase`, `train` the others, both without frames of
        weight 0; `video` all."""
        if split not in ("train", "test", "video"):
            raise ValueError(f"split must be train, test or video; got {split!r}")
        every = range(len(self))
        return [i for i in every if split == "video" or (self._is_test(i) == (split == "test") and self._counts(i))]

    def _counts(self, index: int) -> bool:
        return self.frame_weights is None or self.frame_weights[index] > 0

    def read_as(self, cfg: DataConfig) -> FrameSequence:
        """The sequence as `cfg` has it, read again for that if need be; layout and eyes are those that were found.

        Itself where that would undo what somebody asked for: a part, other masks, or a reading that is not the default.
        """
        if self.reading is None or self.read_again is None:
            return self
        wanted, usual = replace(cfg, format=self.reading.format, eyes=self.reading.eyes), DataConfig()
        names = [each.name for each in fields(usual) if getattr(wanted, each.name) != getattr(self.reading, each.name)]
        if not names or any(getattr(self.reading, name) != getattr(usual, name) for name in names):
            return self
        return self.read_again(wanted)

    def all_alike(self) -> FrameSequence:
        """This sequence with every frame and pixel believed alike, as `data.reliability ignored` has it."""
        return self._with(frame_weights=None, _read_frame=self._read_frame)

    @property
    def left_out(self) -> list[int]:
        """The frames that are neither trained on nor scored, because their weight is 0."""
        return [i for i in range(len(self)) if not self._counts(i)]

    def _is_test(self, index: int) -> bool:
        return is_test_frame(self._first + index, self._test_phase)

    @property
    def test_phase(self) -> int:
        """Which frame of every eight is held out, 0..7; see `is_test_frame`."""
        return self._test_phase

    @property
    def split_rule(self) -> str:
        """Which frames are held out, in words; i counts from the first frame of the whole sequence."""
        rule = f"test iff (i - 1) % {TEST_EVERY} == {self._test_phase}"
        return f"{rule}, without the unreliable frames {number_ranges(self.left_out)}" if self.left_out else rule

    def with_test_phase(self, phase: int) -> FrameSequence:
        """This sequence with another frame of every eight held out; InputError if none would be."""
        view = self._with(_test_phase=phase)
        if phase and not view.indices("test"):
            expected = f"a phase that leaves a test frame of {len(self)} frames"
            raise input_error("data.test_phase", expected, str(phase), "choose a lower one; 0 is the published split.")
        return view

    @property
    def is_training_view(self) -> bool:
        """Whether reading a test frame is an error."""
        return self._holds_out

    def training_view(self) -> FrameSequence:
        """What a method trains on: no ground truth and no right eye, and reading a test frame is an error."""
        return self._with(truth=None, right_eye=None, _holds_out=True)

    def training_part(self, span: FrameSpan) -> FrameList:
        """The training frames of a part of the sequence; see `part`."""
        return self.part(span.start, span.stop).frames("train")

    def part(self, start: int, stop: int) -> FrameSequence:
        """Frames `start` to `stop` - 1 as a sequence of its own, without ground truth; held-out frames stay held out.

        Indices and times of its frames count from its start.
        """
        num = stop - start
        return self._with(
            _cameras=self._cameras[start:stop],
            _first=self._first + start,
            _read_frame=lambda index: replace(self._read_frame(start + index), index=index, time=index / num),
            image_files=self.image_files[start:stop],
            mask_files=self.mask_files[start:stop],
            frame_weights=None if self.frame_weights is None else self.frame_weights[start:stop],
            new_mask_files=[],  # the reader wants those of all frames
            truth=None,
            right_eye=self.right_eye and self.right_eye.part(start, stop),
        )

    def without_masks(self) -> FrameSequence:
        """This sequence with its masks hidden: every pixel counts as tissue."""
        return self.with_tissue(lambda frame: np.ones_like(frame.tissue_mask))

    def with_tissue(self, tissue_of: Callable[[Frame], NDArray[np.bool_]]) -> FrameSequence:
        """This sequence with other tissue masks: `tissue_of` gives that of a frame, (H, W), from the frame as it is."""

        def read(index: int) -> Frame:
            frame = self._read_frame(index)
            return replace(frame, tissue_mask=tissue_of(frame))

        return self._with(_read_frame=read)

    def with_poses(self, cameras: Sequence[Camera]) -> FrameSequence:
        """This sequence with the poses of other cameras, one for each frame; lenses and sizes stay.

        A scene has poses of its own, in which it was trained: they are those to render it from.
        """
        pairs = list(zip(self._cameras, cameras, strict=True))
        if all(np.array_equal(own.world_to_camera, other.world_to_camera) for own, other in pairs):
            return self
        posed = [replace(own, world_to_camera=other.world_to_camera) for own, other in pairs]
        return self._with(
            _cameras=posed, _read_frame=lambda index: replace(self._read_frame(index), camera=posed[index])
        )

    def _with(self, **changes: Any) -> FrameSequence:
        """A view of this sequence with other attributes; frames that are read in another way are cached anew."""
        view = copy(self)
        vars(view).update({"summaries": None, "read_again": None} | changes)
        if "_read_frame" in changes:
            view._cache = BoundedCache(cache_bytes(), _frame_bytes)
        return view

    def fingerprint(self) -> str:
        """SHA-256, in hex, of the names (below the folder) and contents of all files of the sequence."""
        return self.fingerprints().data

    def fingerprints(self) -> Fingerprints:
        """That of all files, and that of the images of its frames."""
        digests = digests_of(self.files)
        images = {file: digests[file] for file in self.image_files}
        return Fingerprints(fingerprint_of(digests, self.path), fingerprint_of(images, self.path) if images else "")

    def demand_unchanged(self, fingerprint: str | None = None) -> None:
        """Raise InputError if a file changed since the sequence was opened, so that frames of two states may be mixed.

        Args:
            fingerprint: that of the sequence; files with other times and the same contents are accepted. None: not.
        """
        states = [state_of(file) for file in self.files]
        if states != self._states and (fingerprint is None or self.fingerprint() != fingerprint):
            demand_same(self.files, states, self._states)
        self._states = states

    def validate(self) -> list[str]:
        """Decode every frame, and return remarks about what is unusual but usable, one line each.

        Raises:
            InputError: a file cannot be used, or no frame has tissue, or no tissue pixel has depth.
        """
        camera, count = self.camera(0), len(self)
        with ThreadPoolExecutor(workers(DECODING_BYTES * camera.width * camera.height)) as pool:
            # Decoding releases the interpreter lock.
            frames = list(pool.map(lambda index: frame_contents(self._decoded(index)), range(count)))
        is_plain = self.layout == "plain"
        demand_trainable(frames, self.indices("train"), self.path, self.mask_name, is_plain=is_plain)
        remarks = list(self.remarks)
        if (tool := 1 - sum(frame.tissue for frame in frames) / count) > TOOL_FRACTION_WARNING:
            masks = self.path / self.mask_name
            remarks.append(f"{masks}: {tool:.0%} of all pixels are masked; the polarity may be inverted")
        if self.depth_is_relative:
            remarks.append(f"{self.path}: the scale of its depth is unknown or assumed; lengths are not millimeters")
        if self.scale is not None:
            remarks.append(f"{self.path}: scale by {self.scale.text}")
        if empty := [index for index in range(count) if not frames[index].num_measured]:
            remarks.append(f"{self.path}: {len(empty)} frames have no depth on tissue, the first is frame {empty[0]}")
        return remarks


def check_sequence(given: object) -> None:
    """Raise InputError unless it is a sequence; a path is not."""
    if not isinstance(given, FrameSequence):
        is_path = isinstance(given, (str, Path))
        got = repr(str(given)) if is_path else type(given).__name__
        fix = f"`endoprior.load_sequence({got if is_path else 'DATA'})`."
        raise input_error("sequence", "a FrameSequence", got, fix)


def _frame_bytes(frame: Frame) -> int:
    arrays = frame.rgb_u8, frame.tissue_mask, frame.depth, frame.depth_valid, frame.weight, frame.depth_confidence
    return sum(array.nbytes for array in arrays if array is not None)


class FrameList(Sequence[Frame]):
    """The frames of a sequence with these indices, read-only and in this order; each is decoded when it is used."""

    def __init__(self, sequence: FrameSequence, indices: list[int]) -> None:
        self.sequence, self.indices = sequence, indices

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> FrameList: ...
    def __getitem__(self, position: int | slice) -> Frame | FrameList:
        """The frame at a position in this list (negative: from the end), or the lazy list of a slice of positions."""
        if isinstance(position, slice):
            return FrameList(self.sequence, self.indices[position])
        return self.sequence.frame(self.indices[position])
