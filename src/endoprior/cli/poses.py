"""`endoprior poses DATA`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import check_range, number_ranges
from ..core.geometry import Convention
from ..core.shell import command
from ..system.console import say
from .arguments import Help, parse
from .progress import Counting

if TYPE_CHECKING:
    from ..prepare.folder_path import FolderPath

TRUTH = Path("truth", "camera_to_world.npy")


@dataclass
class Poses:
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
    poses_unit_mm: float = 1.0
    """mm per unit of the positions in the file of --poses: 1000 for m."""

    def __post_init__(self) -> None:
        check_range("poses_unit_mm", self.poses_unit_mm, 1e-6, 1e6)


HELP = Help(examples=(("DATA",), ("DATA", "--poses", "estimate")))


def run(argv: list[str]) -> None:
    """Find the camera path and write it."""
    args = parse(Poses, argv, "poses", HELP)
    from ..data.folder_edits import POSES
    from ..prepare.camera_path.sequence_path import Reading
    from ..prepare.folder_path import write_folder_path

    with Counting() as progress:
        found = write_folder_path(
            args.data,
            args.poses,
            lambda done, total: progress("following the camera", done, total),
            reading=Reading(args.poses_convention, args.poses_unit_mm),
        )
    for note in found.notes:
        say(f"note: {note}")
    if found.unexplained:
        say(f"note: no camera pose, or another scene, in frames {number_ranges(found.unexplained)}")
    if found.kept is not None:
        say(f"note: the poses that were there are kept in {found.kept}")
    if (args.data / TRUTH).exists():
        _say_errors(args.data / TRUTH, found)
    say(f"{args.data / POSES}: {len(found.camera_to_world)} poses")
    say(f"next: {command('check', args.data)}")


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
