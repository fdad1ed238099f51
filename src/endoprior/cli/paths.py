"""The paths that a user names: a trained scene, its sequence, and where results go."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError, input_error
from ..core.shell import command
from ..data.reading import kind_of
from ..system.atomic import lies_in, temporary_sibling
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


def require_writable_file(option: str, path: Path, keep: Path) -> None:
    """Reject a path that cannot be written, and files of the input folder.

    Args:
        option: the option that names the path.
        path: the file to write; an existing file is replaced.
        keep: the input folder, whose files must not change.
    Raises:
        InputError: names option and path.
    """
    kind = kind_of(path)
    if kind not in ("a file", "nothing"):
        raise input_error(f"{option} {path}", "the path of a file", kind, "Choose another name.")
    if kind == "a file" and lies_in(path, keep):
        raise input_error(f"{option} {path}", f"a path outside of {keep}", "a file in it", "Choose another name.")
    _require_writable(option, path, path.absolute().parent)


def require_new_file(path: Path) -> None:
    """Reject an existing file; the caller has an option --overwrite that permits it."""
    if kind_of(path) == "a file":
        raise input_error(path, "a new file", "one that exists", "Choose another name, or add --overwrite.")


def require_writable_folder(option: str, path: Path) -> None:
    """Reject a path where no folder can be created or written; see `require_writable_file`."""
    kind = kind_of(path)
    if kind not in ("a folder", "nothing"):
        raise input_error(f"{option} {path}", "the path of a folder", kind, "Choose another name.")
    _require_writable(option, path, path.absolute())


def _require_writable(option: str, path: Path, folder: Path) -> None:
    """Try to write a file in the nearest existing parent folder."""
    while kind_of(folder) == "nothing" and folder != folder.parent:
        folder = folder.parent
    try:
        # Not by `tempfile`: on Windows it tries two billion names if the folder is not writable.
        probe = temporary_sibling(folder / "writable")
        probe.touch()
        probe.unlink()
    except OSError as error:
        got = f"{error.strerror} at {folder}"
        raise input_error(f"{option} {path}", "a writable path", got, "Choose another path.") from None
