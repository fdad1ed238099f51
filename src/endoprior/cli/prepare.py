"""Sequence folders from videos, `endoprior prepare VIDEO OUT`; their camera paths, `endoprior poses DATA`; and their
scale, `endoprior scale DATA`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import check_range, frame_list, input_error
from ..core.geometry import Convention
from ..core.shell import command
from ..prepare.config import PrepareConfig
from ..system.console import note_line, say
from .arguments import Command
from .paths import require_input_first
from .progress import Counting

if TYPE_CHECKING:
    from ..prepare.folder_path import FolderPath

MAX_NAMED = 5  # times that a note names; more are counted
TRUTH = Path("truth", "camera_to_world.npy")


@dataclass
class Prepare(Command):
    """Write a sequence folder from an endoscope video: rectified frames, depth, tool masks and camera poses.

    To resume after an interruption, run the same command again. Your video never leaves this computer. Of its metadata
    only its path is kept, in OUT/prepare.json. `depth-anything` and `sam2` are downloaded.
    """

    video: Path = field(metadata={"place": "VIDEO"})
    """Video file, or folder of images and, if there are any, masks."""
    out: Path = field(metadata={"place": "OUT"})
    """Sequence folder to write; must be new or empty."""
    config: PrepareConfig = field(default_factory=PrepareConfig, metadata={"name": ""})

    examples = (
        "video.mp4 DATA",
        "stereo.mp4 DATA --calibration calib.yaml",
        "video.mp4 DATA --start 10 --end 20 --frames-per-second 10",
    )
    basics = "--calibration --right --start --end --frames-per-second --max-width --depth --masks --poses"

    def execute(self) -> None:
        """Prepare the sequence."""
        from ..data.description import RECORD, TOOLS_FOUND, read_description
        from ..prepare import prepare

        require_input_first("prepare", self.video, self.out)
        with Counting() as progress:
            done = prepare(self.video, self.out, self.config, progress)
        for note in [*done.notes, *self._segments()]:
            say(note_line(note))
        say(f"note: {done.out / RECORD} holds the path of your video; delete it before you share the folder")
        say(f"{done.out}: {done.num_frames} frames of {done.size[0]}x{done.size[1]}")
        if f"no {TOOLS_FOUND}" in read_description(done.out / "sequence.json").get("sources", {}).get("masks", ""):
            say(f"no tools were found; if there are any, paint them: `{command('view', done.out)}`")
        say(f"next: `{command('check', done.out)}` and `{command('train', done.out, 'RUN')}`")

    def _segments(self) -> list[str]:
        """Which times of a video that is used as a whole are not clear, and the command for the best part."""
        from ..pipeline.choice import choose_segment

        if (self.config.start, self.config.end, self.config.stir) != (0, math.inf, None):
            return []
        choice = choose_segment(self.video, self.out, self.config.folder_rate)
        bad = [f"{each.start:.1f}-{each.end:.1f} s {each.reason}" for each in choice.stretches if each.reason]
        if not choice.number:
            return []
        named = ", ".join(bad[:MAX_NAMED]) + (f" and {len(bad) - MAX_NAMED} more" if bad[MAX_NAMED:] else "")
        start, end = (f"{time:.2f}" for time in choice.span)
        best = command("prepare", self.video, "OUT", "--start", start, "--end", end)
        what = f"in no segment: {named}" if bad else f"{len(choice.segments)} scenes"
        return [f"the whole video is used; {what}. The best part: `{best}`"]


@dataclass
class Poses(Command):
    """Find the camera path of a sequence folder and write it to DATA/poses_bounds.npy and DATA/sequence.json.

    Poses that this program did not write are kept in DATA/poses_bounds_before.npy. Relative depth is brought to the
    scale of the path. DATA/camera_path.json holds the method and the uncertainty of each pose.
    """

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    poses: str = "auto"
    """`auto` (static, or estimated if the camera moves), `estimate` (by our own tracks, or by COLMAP if it is installed
    and explains the frames better), `own`, `colmap`, `auto-own`, `still`, or a file as for `prepare --poses`."""
    poses_convention: Convention = "opencv"
    """Meaning of the matrices in the file of --poses, as for `prepare`."""
    poses_unit_mm: float | None = None
    """mm per unit of the positions in the file of --poses, as for `prepare`."""

    examples = ("DATA", "DATA --poses estimate")

    def __post_init__(self) -> None:
        if self.poses_unit_mm is not None:
            check_range("poses_unit_mm", self.poses_unit_mm, 1e-6, 1e6)

    def execute(self) -> None:
        """Find the camera path and write it."""
        from ..data.poses import POSES
        from ..prepare.camera_path.sequence_path import Reading
        from ..prepare.folder_path import write_folder_path

        reading = Reading(self.poses_convention, self.poses_unit_mm)
        with Counting() as progress:
            found = write_folder_path(self.data, self.poses, partial(progress, "following the camera"), reading=reading)
        for note in found.notes:
            say(note_line(note))
        if found.unexplained:
            say(f"note: no camera pose, or another scene, in {frame_list(found.unexplained)}")
        if found.kept is not None:
            say(f"note: the poses that were there are kept in {found.kept}")
        if (self.data / TRUTH).exists():
            _say_errors(self.data / TRUTH, found)
        say(f"{self.data / POSES}: {len(found.camera_to_world)} poses")
        say(f"next: `{command('check', self.data)}`")


def _say_errors(truth: Path, found: FolderPath) -> None:
    """Compare with the true path."""
    from ..evaluation.scorers.camera_path import trajectory_errors
    from ..prepare.camera_path.pose_file import read_poses

    true = read_poses(truth, len(found.camera_to_world))
    errors = trajectory_errors(found.camera_to_world, true, with_scale=found.relative)
    aligned = "Sim(3)" if found.relative else "SE(3)"
    say(
        f"against the true path, aligned by {aligned}: {errors.ate_mm:.2f} mm (ATE), {errors.rpe_mm:.2f} mm and "
        f"{errors.rpe_deg:.3f} degrees from frame to frame, {errors.rotation_error_deg:.2f} degrees in all"
    )


@dataclass
class Scale(Command):
    """Bring the relative depth of a sequence folder to mm, by something of known size in its images.

    Depth, poses and known points are changed all or not at all. Another scale replaces one that was given before.
    """

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    known_length: tuple[str, ...] = field(default=(), metadata={"metavar": "FRAME,X1,Y1,X2,Y2,MM"})
    """Two points of tissue, x, y in px of the frame, from 0, are MM apart. One or more; several are averaged."""
    shaft_mm: float = field(default=0.0, metadata={"metavar": "MM"})
    """Diameter of all instruments' shafts, most often 8 in robotic surgery, else 5. Their tips must touch tissue in
    some frames. Less sure than --known-length."""

    examples = ("DATA --known-length 12,310,205,402,198,20", "DATA --shaft-mm 8")

    def execute(self) -> None:
        """Find the scale and write it."""
        from ..data.edit import finish_scale
        from ..prepare.scale import scale_folder

        if not (self.known_length or self.shaft_mm):
            if finish_scale(self.data):
                say(f"{self.data}: the scale whose change was interrupted is complete now")
                return
            fix = f"`{command('scale', self.data, '--known-length', '12,310,205,402,198,20')}` with your numbers."
            raise input_error("endoprior scale", "--known-length or --shaft-mm", "neither", fix)
        scale = scale_folder(self.data, self.known_length, self.shaft_mm)
        say(f"{self.data}: 1 unit of relative depth is {scale.factor:.4g} mm, by {scale.text}")
        say(f"next: `{command('check', self.data)}`")
