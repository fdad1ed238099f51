"""First pass over a clip: count its frames, detect borders and text, and fix the geometry of all frames."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..data.reading import kind_of
from ..footage.border import CERTAIN as SHARP
from ..footage.border import Outline, Outside, Strips, find_outline, hidden_by_moving_border
from ..footage.image_operations import dilated, square
from ..footage.overlays import find_strokes, without_strokes
from ..footage.round_border import CERTAIN, Circle
from ..system.console import ToDo
from ..system.memory import cache_bytes
from .burnt_in_text import BurntInText, find_text
from .calibration import fitted
from .config import Layout, PrepareConfig, parse_rectangle
from .frame_geometry import FrameGeometry, demand_within, make_geometry
from .source import ImageFolder
from .video_clip import Clip, FrameSelection, StereoFrame

SAMPLES = 24  # number of frames used to detect borders, text, tools and lighting
NEARLY_BLACK_LEVEL, NEARLY_WHITE_LEVEL = 40.0, 230.0
"""Images whose brightest percent of values is below the first are nearly black; darkest above the second, white."""
Image, Mask, Depth = NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]


@dataclass(frozen=True)
class MeasuredFrame:
    """A rectified frame and its depth."""

    position: int  # position in the sequence, from 0
    index: int  # position in the source
    rgb_u8: Image  # (H, W, 3)
    right_u8: Image | None  # (H, W, 3) image of the right camera, rectified; None if monocular
    depth: Depth | None = None  # (H, W) mm, 0 where missing; None before it is measured

    @classmethod
    def of(cls, seen: StereoFrame, geometry: FrameGeometry, position: int = 0) -> MeasuredFrame:
        """The frame of source images, not yet measured."""
        right = None if seen.right is None else geometry.image(seen.right, right=True)
        return cls(position, seen.index, geometry.image(seen.left), right)


@dataclass
class FirstPass:
    """Result of the first pass."""

    indices: list[int]  # positions of the selected frames in the source
    samples: list[StereoFrame]  # at most `SAMPLES` of them, evenly spaced
    geometry: FrameGeometry
    notes: list[str] = field(default_factory=list)  # notes for the user on borders and the lens, one line each
    video_notes: list[str] = field(default_factory=list)  # on the video, and which of its images are not used
    damaged: frozenset[int] = frozenset()  # those of `indices` whose images are damaged
    stored_size: tuple[int, int] | None = None  # (width, height) of one camera's image of pixels that are not square
    image_names: list[str] = field(default_factory=list)  # of a source folder, without suffixes; empty for a video
    hides: bool = False  # whether drawings in single frames are searched
    moving_border: float | None = None  # level of a border that moves: see `footage.border.hidden_by_moving_border`
    frames: list[StereoFrame] | None = None  # all selected frames, in order; None if they do not fit into memory
    text: BurntInText = field(default_factory=BurntInText)  # what `find_text` found

    def all_frames(self, clip: Clip) -> Iterable[StereoFrame]:
        """The selected frames, kept in memory or decoded once more, with burnt-in text painted."""
        return map(self.text.painted, self.frames or clip.stereo_frames(clip.selection()))

    def find_text(self, clip: Clip) -> None:
        """Search the clip for burnt-in text, and paint the samples."""
        self.text = find_text(self.samples, lambda: self.all_frames(clip), self.indices, self.geometry.view)
        self.samples = [self.text.painted(frame) for frame in self.samples]
        self.notes += self.text.notes

    def hidden(self, index: int, rgb_u8: Image) -> Mask:
        """(H, W) True where a frame (H, W, 3) shows nothing of the body, and others do: text, drawings, or a border.

        Args:
            index: position of the frame in the source.
        """
        found = find_strokes(rgb_u8) if self.hides else np.zeros(rgb_u8.shape[:2], bool)
        if index in self.text.boxes:
            text = self.text.mask(index, self.geometry.source_size[::-1])
            found |= dilated(self.geometry.values(text), square(1))  # the rim of the text is mixed with tissue
        if self.moving_border is not None:
            found |= hidden_by_moving_border(rgb_u8, self.moving_border, self.geometry.inside)
        return found

    def frame_of(self, read: Callable[[tuple[int, int]], NDArray]) -> NDArray:
        """The frame (H, W) of a file that has the size of the source images, of the frames, or of the stored pixels.

        Args:
            read: gives the file's values; it raises InputError unless they have this (width, height).
        """
        geometry = self.geometry
        try:
            return geometry.values(read(geometry.source_size))
        except InputError:
            with suppress(InputError):
                return geometry.values(read(geometry.size))
            with suppress(InputError):
                if self.stored_size is not None:
                    values = read(self.stored_size)
                    stored = values.astype(np.uint8 if values.dtype == bool else values.dtype)
                    square = cv2.resize(stored, geometry.source_size, interpolation=cv2.INTER_NEAREST_EXACT)
                    return geometry.values(square.astype(values.dtype))
            raise


def run_first_pass(clip: Clip, cfg: PrepareConfig) -> FirstPass:
    """Decode the selected frames once.

    Raises:
        InputError: too few or too many frames, or a file is damaged.
    """
    indices, damaged, samples, selection, frames = _decode_once(clip, cfg)
    if clip.was_damaged:  # again, now by one thread, which finds all damage
        indices, damaged, samples, selection, frames = _decode_once(clip, cfg)
    if len(indices) < 2:
        fix = "Check --start, --end and --frames-per-second."
        raise input_error(clip.source.path, "at least 2 frames in the selection", str(len(indices)), fix)
    lefts = [frame.left for frame in samples]
    video_notes = [*clip.notes, *_timing_notes(selection, cfg), *_brightness_notes(lefts)]
    outline = find_outline(without_strokes(lefts)) if cfg.border == "auto" else None
    geometry, notes = _geometry(clip, cfg, outline)
    if outline is not None:
        notes += border_notes(outline.strips, outline.circle, float(1 - geometry.inside.mean()), outline.other)
        if drawn := np.mean([find_strokes(image).any() for image in lefts]):
            notes.append(f"boxes or text are drawn into {drawn:.0%} of the samples: masked in each frame, as no tissue")
    if clip.calibration is None:
        assumed = f"a field of view of {cfg.field_of_view_degrees:g} degrees is assumed"
        focal = f"f = {geometry.matrix[0, 0]:.0f} px"
        notes.append(
            ToDo(f"no calibration; {assumed} ({focal}). To change it: --calibration or --field-of-view-degrees.")
        )
    return FirstPass(
        indices,
        samples,
        geometry,
        notes,
        video_notes,
        damaged,
        clip.stored_size,
        image_names=[file.stem for file in clip.source.files] if isinstance(clip.source, ImageFolder) else [],
        hides=outline is not None,
        moving_border=outline.other.level if outline is not None and outline.other.moves else None,
        frames=frames,
    )


def _geometry(clip: Clip, cfg: PrepareConfig, outline: Outline | None) -> tuple[FrameGeometry, list[str]]:
    """How source images become frames, inside of a detected outline if there is one; and notes on the calibration."""
    size, calibration, name, notes = clip.camera_size, clip.calibration, str(cfg.calibration), list[str]()
    across, down = _stretch(clip.layout) if cfg.squeezed_eyes else (1, 1)
    if calibration is not None:
        full = size[0] * across, size[1] * down
        calibration, words = fitted(calibration, full, name, squeezed=cfg.squeezed_eyes)
        notes = [*calibration.notes, *words]
    blank = [parse_rectangle(text, "--blank") for text in cfg.blank]
    for rectangle in blank:
        demand_within(rectangle, size, "--blank")
    geometry = make_geometry(
        size, calibration, stereo=clip.stereo, name=name, stretch=(across, down),
        field_of_view_degrees=cfg.field_of_view_degrees, max_width=cfg.max_width,
        crop=parse_rectangle(cfg.crop, "--crop") if cfg.crop else None, blank=blank,
        strips=outline and outline.strips, circle=outline and outline.circle, outside=outline and outline.outside,
    )  # fmt: skip
    return geometry, notes


def _brightness_notes(images: list[Image]) -> list[str]:
    """A note if images are nearly black or nearly white."""
    notes = []
    brightest = float(np.median([np.percentile(image, 99) for image in images]))
    if brightest < NEARLY_BLACK_LEVEL:
        words = f"their brightest parts have {brightest:.0f} of 255. Export them brighter"
        notes.append(f"the images are nearly black: {words}")
    darkest = float(np.median([np.percentile(image, 1) for image in images]))
    if darkest > NEARLY_WHITE_LEVEL:
        words = f"their darkest parts have {darkest:.0f} of 255. Export them darker, or choose another part"
        notes.append(f"the images are nearly white: {words}")
    return notes


def _decode_once(
    clip: Clip, cfg: PrepareConfig
) -> tuple[list[int], frozenset[int], list[StereoFrame], FrameSelection, list[StereoFrame] | None]:
    """Positions of the selected frames, the damaged ones, samples, the selection, and the frames themselves if all of
    them fit into memory; InputError if too many.
    """
    indices, damaged, samples, every, selection = list[int](), set[int](), list[StereoFrame](), 1, clip.selection()
    frames: list[StereoFrame] | None = []
    space = cache_bytes()
    for count, frame in enumerate(clip.stereo_frames(selection)):
        if count % every == 0 and len(samples) == SAMPLES:
            samples, every = samples[::2], 2 * every
        if count % every == 0:
            samples.append(frame)
        indices.append(frame.index)
        space -= frame.nbytes
        if space < 0:
            frames = None
        elif frames is not None:
            frames.append(frame)
        if frame.damaged:
            damaged.add(frame.index)
        if len(indices) > cfg.max_frames:
            got = f"{clip.source.num_frames or 'more'} in the file"
            fix = "Choose a part with --start and --end, lower --frames-per-second, or raise --max-frames."
            raise input_error(str(clip.source.path), f"at most {cfg.max_frames} frames", got, fix)
    return indices, frozenset(damaged), samples, selection, frames


def _stretch(layout: Layout) -> tuple[int, int]:
    """Factors (across, down) that give images of a squeezed layout their shape back."""
    if layout not in ("side-by-side", "top-bottom"):
        fix = "Set --layout, or remove --squeezed-eyes."
        raise input_error("--squeezed-eyes", "both cameras side by side or top-bottom in a frame", layout, fix)
    return (2, 1) if layout == "side-by-side" else (1, 2)


def _timing_notes(selection: FrameSelection, cfg: PrepareConfig) -> list[str]:
    notes, uneven = [], selection.uneven_steps
    if uneven > max(2, 0.02 * selection.taken):
        notes.append(f"variable frame rate: {uneven} uneven time steps; frames were selected on an even time grid")
    if selection.gaps:
        notes.append(f"{selection.gaps} steps of the time grid have no frame and are left out")
    if selection.between:
        every = f"{selection.taken + selection.between} images in the time range are not used"
        hint = "" if cfg.frames_per_second else ". To use more of them: a higher --frames-per-second"
        rate = f"a frame every {1000 / selection.frames_per_second:.4g} ms is taken"
        notes.append(f"{selection.between} of {every}: {rate}{hint}")
    return notes


def border_notes(
    strips: Strips | None, circle: Circle | None, outside: float, other: Outside | None = None
) -> list[str]:
    """Notes on detected borders. Args: outside: share of the pixels of a frame that show nothing."""
    notes = []
    if strips:
        sides = ", ".join(f"{n} px {side}" for side, n in vars(strips).items() if n)
        notes.append(f"black bars or console strips were cropped: {sides}. To keep them: --border keep.")
    if circle:
        notes.append(
            f"round border: center ({circle.center_x:.0f}, {circle.center_y:.0f}), radius {circle.radius:.0f} px. Its "
            f"outside and its rim of {circle.margin_px:.0f} px are masked, {outside:.1%} of a frame."
        )
        if circle.agreement < CERTAIN:
            agree = f"{circle.agreement:.0%} of it agree with the images"
            fix = "use --border keep, with --crop and --field-of-view-degrees"
            notes.append(ToDo(f"the round border is uncertain: {agree}. If it is wrong, {fix}."))
    if other and other.mask.any():
        moving = ", and it moves: what it hides is masked in each frame" if other.moves else ""
        notes.append(f"the image has a border: {other.mask.mean():.1%} of the source is outside and masked{moving}.")
        if other.images > 1:
            what = f"a frame shows {other.images} images; the largest is used"
            notes.append(ToDo(f"{what}. To use another one: --crop."))
        if other.sharpness < SHARP:
            what = f"the border is uncertain: {other.sharpness:.0%} of its outline is sharp"
            notes.append(ToDo(f"{what}. See check.png; if it is wrong, use --border keep, with --crop."))
    return notes


def input_facts(cfg: PrepareConfig) -> dict[str, dict[str, object]]:
    """Identity of each file and folder that an option names, by the option."""
    named = {
        "--right": cfg.right, "--calibration": cfg.calibration, "--stir": cfg.stir, "--masks": Path(cfg.masks),
        "--depth": Path(cfg.initial_depth), "--poses": Path(cfg.poses),
    }  # fmt: skip
    return {name: source_facts(path) for name, path in named.items() if path and kind_of(path) != "nothing"}


def source_facts(path: Path) -> dict[str, object]:
    """Identity of a file or folder: its name, and the name, size and modification time of its files.

    Files one folder further down count too: masks can have a folder per object or per video.
    """
    files = [path]
    if kind_of(path) == "a folder":
        files = sorted(path.iterdir())
        folders = [each for each in files if each.is_dir() and os.access(each, os.R_OK | os.X_OK)]
        files += [file for folder in folders for file in sorted(folder.iterdir())]
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.exists()]
    return {"name": path.name, "files": [list(entry) for entry in stats]}
