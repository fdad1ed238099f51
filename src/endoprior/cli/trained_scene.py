"""Open the scene of a run that the user names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError

if TYPE_CHECKING:
    from ..model.scene import Scene


def open_scene(run: Path) -> Scene:
    """`load_scene` with an error that says what to type if the path is a sequence folder or a video.

    Raises:
        InputError: there is no scene that can be read.
    """
    from ..data.recognize import not_a_run
    from ..model.scene import load_scene

    try:
        return load_scene(run)
    except InputError:
        if error := not_a_run(run):
            raise error from None
        raise
