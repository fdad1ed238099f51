"""The paths that a user names: a trained scene, its sequence, and where results go."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError, input_error
from ..core.shell import command
from ..data import FrameSequence, load_sequence
from ..data.image_folders import beside
from ..data.load import is_input, not_a_run
from ..data.reading import Kind, kind_of
from ..system.atomic import lies_in, temporary_sibling
from ..system.console import say
from ..system.signals import held_back

if TYPE_CHECKING:
    from ..model.scene import RenderedScene, Scene


def folder_of(run: Path) -> Path:
    """The run folder: `run` itself, or the folder of a scene's file."""
    return run.parent if os.path.isfile(run) else run  # pathlib raises for a name that is too long


def open_scene(run: Path) -> RenderedScene:
    """`load_scene` with an error that says what to type if the path is a sequence folder or a video."""
    from ..model.scene_file import load_scene

    try:
        return load_scene(run)
    except InputError:
        if error := not_a_run(run):
            raise error from None
        raise


def open_gaussians(run: Path) -> Scene:
    """`open_scene` for what needs Gaussians; InputError for a scene without."""
    from ..model.scene import with_gaussians

    return with_gaussians(open_scene(run), run)


def sequence_of(scene: RenderedScene, run: Path, data: Path | None) -> FrameSequence:
    """The sequence of a run's scene, the one that the user names if any, with the scene's poses."""
    from ..evaluation.scoring import scored_data
    from ..runs.folder import sequence_of_run

    sequence = load_sequence(data or sequence_of_run(run), scored_data(scene.config.data))
    if len(sequence) != len(scene.cameras):
        fix = "`--data FOLDER` with the sequence of the run."
        raise input_error(sequence.path, f"{len(scene.cameras)} frames", str(len(sequence)), fix)
    return sequence.with_poses(scene.cameras)


def sequence_if_there(scene: RenderedScene, run: Path, data: Path | None, without: str) -> FrameSequence | None:
    """`sequence_of`; None, with a note of what is missing without it, if the user names none and it cannot be read."""
    try:
        return sequence_of(scene, run, data)
    except InputError as error:
        if data:
            raise
        say(f"note: without input frames {without}. {error}")
        return None


def require_input_first(name: str, data: Path, out: Path) -> None:
    """Reject DATA and OUT in the wrong order, and the same path for both, where what was meant is plain."""
    if (kind := kind_of(data)) == "nothing" and is_input(out):
        fix = f"the input comes first: `{command(name, out, data)}`."
        raise input_error(data, "a video or a folder", "no such file or folder", fix)
    if kind != "nothing" and os.path.abspath(data) == os.path.abspath(out):
        ending = "run" if name == "train" else "data" if name == "prepare" else "out"
        fix = f"`{command(name, data, beside(data, ending))}`."
        raise input_error(out, "a new folder for the results", "the input", fix)


def require_writable_file(option: str, path: Path, keep: Path) -> None:
    """Reject the path of an option that cannot be written, and existing files of the input folder `keep`."""
    _require_writable(option, path, "a file", path.absolute().parent)
    if path.exists() and lies_in(path, keep):
        raise input_error(f"{option} {path}", f"a path outside of {keep}", "a file in it", "Choose another name.")


def require_writable_folder(option: str, path: Path) -> None:
    """Reject the path of an option where no folder can be created or written."""
    _require_writable(option, path, "a folder", path.absolute())


def _require_writable(option: str, path: Path, wanted: Kind, folder: Path) -> None:
    """Reject what is no `wanted` one, and try to write a file in the nearest existing parent of `folder`."""
    if (kind := kind_of(path)) not in (wanted, "nothing"):
        raise input_error(f"{option} {path}", f"the path of {wanted}", kind, "Choose another name.")
    while kind_of(folder) == "nothing" and folder != folder.parent:
        folder = folder.parent
    try:
        # Not by `tempfile`: on Windows it tries two billion names if the folder is not writable.
        probe = temporary_sibling(folder / "writable")
        with held_back():  # a signal between the two would leave the probe
            probe.touch()
            probe.unlink()
    except OSError as error:
        got = f"{error.strerror} at {folder}"
        raise input_error(f"{option} {path}", "a writable path", got, "Choose another path.") from None
