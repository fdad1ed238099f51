"""The camera path of a clip: by our own tracks, or by COLMAP where it is installed and explains the frames better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from ...core.checks import input_error
from ...core.shell import install_command
from .colmap import LONGEST, SECONDS_AN_IMAGE, colmap_path, is_installed, stride_of
from .explained import explained_share
from .own import own_path
from .seen import CameraPath, Lens, PoseInput

How = Literal["best", "own", "colmap"]


def colmap_seconds(how: How, count: int) -> float:
    """About how long COLMAP takes to find the path of a clip of `count` frames, s; 0 where it takes no part."""
    if how == "own" or not is_installed() or (how == "best" and count > LONGEST):
        return 0.0
    return SECONDS_AN_IMAGE * len(range(0, count, stride_of(count)))


def find_path(
    frame: Callable[[int], PoseInput],
    count: int,
    lens: Lens,
    size: tuple[int, int],
    how: How = "best",
    *,
    refine_focal: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> CameraPath:
    """Estimate the camera path.

    Args:
        frame: reads frame i.
        size: (width, height), px.
        how: `best` takes what explains the frames better.
        refine_focal: the focal length is an assumption.
        progress: is told the number of frames followed.
    Raises:
        InputError: `colmap` without its package, or without a result.
    """
    if how == "colmap" and not is_installed():
        raise input_error("--poses colmap", "the package pycolmap", "none", f"`{install_command('poses')}`.")
    own, follower = own_path(frame, count, lens, size, refine_focal=refine_focal, progress=progress)
    if how == "own" or not is_installed():
        return own
    if how == "best" and (own.breathes or count > LONGEST):  # COLMAP would give breathing to the camera
        return own
    other = colmap_path(frame, count, follower, refine_focal=refine_focal)
    if other is None:
        if how == "colmap":
            raise input_error("--poses colmap", "images that COLMAP can register", "too few", "Use `--poses own`.")
        return replace(own, notes=[*own.notes, "COLMAP registers too few frames; the path is our own"])
    other = replace(other, focal_factor=own.focal_factor * other.focal_factor)
    mine, theirs = (explained_share(follower.tracks, lens, path) for path in (own, other))
    best = other if how == "colmap" or theirs > mine else own
    note = f"camera path by {best.method}: COLMAP explains {theirs:.1%} of the held-out tracks, our own path {mine:.1%}"
    return replace(best, notes=[*own.notes, note, *other.notes] if best is own else [*best.notes, note])
