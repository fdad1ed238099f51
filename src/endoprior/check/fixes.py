"""What to type against a problem: commands in backticks, complete, and edits of `sequence.json`. Pure functions."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

from ..core.checks import number_ranges, read_ranges
from ..core.shell import changed_options, command, command_of
from .facts import Facts

FEWEST_FRAMES = 2
"""One to train and one to test."""
MEASURED_DEPTH = dict.fromkeys(("--depth", "--depth-unit-mm", "--depth-relative"))
"""Options of depth that comes from files; without them `prepare` measures it."""


def set_values(facts: Facts, **values: Any) -> str:
    """The edit that sets entries of `sequence.json`; it may not exist yet."""
    entries = ", ".join(f'"{name}": {value}' for name, value in values.items())
    file = facts.path / "sequence.json"
    return f"set {entries} in {file}" if facts.described else f"write {{{entries}}} to {file}"


def train(facts: Facts, **changes: Any) -> str:
    """The command that trains with other options of `DataConfig` than those of this check."""
    options = changed_options(replace(facts.data, **changes), "data.")
    return f"`{command_of('train', (facts.path, 'RUN'), options)}`"


def skip(facts: Facts, frames: tuple[int, ...]) -> str:
    """The command that trains without some frames, numbered as in this check; a look at the files if few are left."""
    if facts.frames - len(set(frames)) < FEWEST_FRAMES:
        return f"look at the images in {facts.path}: they may not be one video of one scene"
    before = read_ranges("skip_frames", facts.data.skip_frames)
    # Positions of the frames of this check among those that it would have without `skip_frames`.
    places = [place for place in range(facts.frames + len(before)) if place not in before]
    left_out = sorted({*before, *(places[frame] for frame in frames)})
    return train(facts, skip_frames=number_ranges(left_out, len(left_out)).replace(" ", ""))


def longest_part(facts: Facts, jumps: tuple[int, ...]) -> str:
    """The command that trains on the longest part between jumps, each the first frame of a part."""
    edges = [0, *jumps, facts.frames]
    first, end = max(pairwise(edges), key=lambda part: part[1] - part[0])
    if first == 0 and not facts.data.skip_frames:
        return train(facts, first_frames=end)
    return skip(facts, (*range(first), *range(end, facts.frames)))


def measure_depth_again(facts: Facts) -> str | None:
    """The command that measures depth by another method than the present one; None if there is none."""
    remake, present = facts.remakes.best, facts.sources.get("depth", "")
    if remake is None or present == "shading":
        return None
    return remake.command(MEASURED_DEPTH | ({"--depth": ("shading",)} if present.startswith("stereo") else {}))


def move_rows(facts: Facts) -> str:
    """What brings the rows of both cameras together: the command that moves them, or another calibration."""
    video, frames = facts.remakes.from_video, facts.remakes.from_frames
    if video and "--row-offset" not in video.options:
        return f"{video.command({'--row-offset': ('auto',)})}, or pass the calibration that belongs to this video"
    if video:
        return f"{video.command({'--calibration': ('FILE',)})}; FILE must belong to this video"
    if frames and "--right" in frames.options:
        return frames.command(MEASURED_DEPTH | {"--row-offset": ("auto",)})
    return "rectify both cameras by their calibration"


def state_size(facts: Facts) -> str:
    """The command that states for images of which size the calibration was made."""
    remake, fix = facts.remakes.from_video, "nothing if that is so"
    return f"{fix}; else {remake.command({'--calibration-size': ('WIDTHxHEIGHT',)})}" if remake else fix


def rescale_camera(facts: Facts, factor: float) -> str:
    """What corrects a camera for images `factor` times as large, and stereo depth, which comes from the same numbers.

    The command that states the size, if the video is known; else the edit of all numbers together.
    """
    camera, record, video = facts.camera, facts.remakes.record, facts.remakes.from_video
    if video and record and "--calibration" in video.options:
        size = "x".join(str(round(side * factor)) for side in record.source_size)
        return f"{video.command({'--calibration-size': (size,)})}, if the calibration was made at this size"
    numbers = dict(zip(("fx", "fy", "cx", "cy"), (camera.fx, camera.fy, camera.cx, camera.cy), strict=True))
    values = {name: f"{value * facts.data.shrink / factor:g}" for name, value in numbers.items()}
    if facts.sources.get("depth", "").startswith("stereo"):
        values["depth_scale"] = f"{facts.depth.scale / factor:.6g}"
    return f"{set_values(facts, **values)}, or what the calibration says for these images"


def convert_poses(facts: Facts, convention: str, unit: float) -> str:
    """The command that reads the stored poses in another convention, in the folder itself where that is possible."""
    options = {"--poses-convention": (convention,)} if convention != "opencv" else {}
    options |= {"--poses-unit-mm": (f"{unit:.4g}",)} if unit != 1 else {}
    file, remake = facts.path / "poses_bounds.npy", facts.remakes.from_frames
    if remake and file.is_file():
        in_place = f"`{command_of('poses', (facts.path,), {'--poses': (str(file),)} | options)}`"
        return f"{in_place}, which keeps the old ones in poses_bounds_before.npy"
    return "store camera-to-world matrices in mm with OpenCV axes (x right, y down, z forward)"


def estimate_poses(facts: Facts) -> str:
    """What to do about poses that fit in no convention: match them to the frames, or estimate them."""
    fix = "check that each pose stands in the row of its frame"
    if facts.remakes.from_frames and (facts.path / "poses_bounds.npy").is_file():
        fix += f", or `{command('poses', facts.path, '--poses', 'estimate')}` finds the camera path"
    return fix


def detect_tools(facts: Facts) -> str | None:
    """The command that finds tools; None if this was done, or cannot be."""
    remake, present = facts.remakes.best, facts.sources.get("masks", "")
    if remake is None or "tools found" in present:
        return None
    return remake.command({"--masks": None, "--mask-tool-value": None})


def mask_tools(facts: Facts) -> str:
    """What adds tools to masks without any: the command that detects them, else painting, or masks of the user."""
    if command := detect_tools(facts):
        return command
    if not facts.takes_masks:
        return "leave out its frames with --data.skip-frames; this layout has no masks"
    painted = f"paint them white (255) in {facts.path / 'masks'}"
    if facts.remakes.best is None:
        return painted
    given = facts.remakes.best.command({"--masks": ("FOLDER",), "--mask-tool-value": None})
    return f"{painted}, or {given} with a mask for each frame in FOLDER"


def mark_in_masks(facts: Facts, what: str) -> str:
    """The edit that excludes a part of every frame."""
    return f"mark {what} in the masks" if facts.takes_masks else "nothing can exclude it: this layout has no masks"


def correct_masks(facts: Facts) -> str:
    """The command that shows masks and takes corrections."""
    return f"look at them and correct them: `{command('view', facts.path)}`"


def in_stored_px(facts: Facts, *values: float) -> list[int]:
    """Pixels of the frames as read, in pixels of the stored frames."""
    return [round(value * facts.data.shrink) for value in values]
