"""The camera path estimated from the footage of a sequence, in a copy of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endoprior.core.checks import InputError, input_error
from endoprior.data import FrameSequence
from endoprior.data.description import read_description
from endoprior.data.folder_edits import BACKUP, POSES
from endoprior.prepare.folder_path import write_folder_path
from endoprior.system.atomic import write_json

FIX = "remove `poses: estimated`."
LENS = "as the sequence has it"
"""Source of the focal length in the copy: scores use the lens of the sequence, so that it is not refined."""


def demand_given_path(sequence: FrameSequence) -> None:
    """Raise InputError if a sequence has no poses to compare with, or is in no folder that can take others."""
    folder = sequence.path
    if not (folder / POSES).exists() or not all((folder / part).is_dir() for part in ("images", "masks", "depth")):
        raise input_error(folder, f"a folder with images/, masks/, depth/ and {POSES}", "another layout", FIX)
    if sequence.poses_are_estimated:
        raise input_error(folder, "given poses, to compare with", f"those by {sequence.sources['poses']}", FIX)
    first = sequence.camera(0).world_to_camera
    if all(np.array_equal(sequence.camera(i).world_to_camera, first) for i in range(len(sequence))):
        raise InputError(f"{folder}: the camera does not move. Fix: {FIX[0].upper()}{FIX[1:]}")


def put_estimated_path(sequence: FrameSequence, copy: Path) -> None:
    """Replace the poses in a copy of the folder of a sequence, as `endoprior poses` does; the old ones are removed.

    Raises:
        InputError: a file cannot be used or written.
    """
    described, camera = read_description(copy / "sequence.json"), sequence.camera(0)
    sources = sequence.sources | described.get("sources", {}) | {"lens": LENS}
    # Some layouts have these facts in files of their own.
    facts = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    facts |= {"depth_relative": sequence.depth_is_relative, "sources": sources}
    write_json(copy / "sequence.json", described | facts)
    write_folder_path(copy)
    (copy / BACKUP).unlink(missing_ok=True)
