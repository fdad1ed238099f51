"""Open the scene of a run that the user names, and its sequence."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError, input_error
from ..core.shell import command
from ..system.console import say

if TYPE_CHECKING:
    from ..data import FrameSequence
    from ..model.scene import RenderedScene, Scene


def folder_of(run: Path) -> Path:
    """The run folder: `run` itself, or the folder of a scene's file."""
    return run.parent if os.path.isfile(run) else run  # pathlib raises for a name that is too long


def open_scene(run: Path) -> RenderedScene:
    """`load_scene` with an error that says what to type if the path is a sequence folder or a video.

    Raises:
        InputError: there is no scene that can be read.
    """
    from ..data.load import not_a_run
    from ..model.scene_file import load_scene

    try:
        return load_scene(run)
    except InputError:
        if error := not_a_run(run):
            raise error from None
        raise


def open_gaussians(run: Path) -> Scene:
    """`open_scene` for what needs Gaussians.

    Raises:
        InputError: as `open_scene`, or the scene has none.
    """
    scene = open_scene(run)
    reject_without_gaussians(scene, run)
    return scene


def reject_without_gaussians(scene: RenderedScene, run: Path) -> None:
    """Reject a radiance field.

    Raises:
        InputError: the scene has no Gaussians.
    """
    from ..model.scene import Scene

    if not isinstance(scene, Scene):
        fix = f"`{command('render', run)}` makes images and a video of it."
        raise input_error(run, "a scene of Gaussians", f"a radiance field ({scene.config.method})", fix)


def sequence_of(scene: RenderedScene, run: Path, data: Path | None, without: str) -> FrameSequence | None:
    """The sequence of a run's scene, with the scene's poses; None, with a note, if it does not exist any more.

    Args:
        run: run folder. data: sequence folder that the user names, if any.
        without: what the note says is missing.
    Raises:
        InputError: `data` does not fit the run.
    """
    from ..data import load_sequence
    from ..evaluation.scoring import scored_data
    from ..runs.folder import sequence_of_run

    try:
        sequence = load_sequence(data or sequence_of_run(run), scored_data(scene.config.data))
    except InputError as error:
        if data:
            raise
        say(f"note: without input frames {without}. {error}")
        return None
    if len(sequence) != len(scene.cameras):
        fix = "`--data FOLDER` with the sequence of the run."
        raise input_error(sequence.path, f"{len(scene.cameras)} frames", str(len(sequence)), fix)
    return sequence.with_poses(scene.cameras)
