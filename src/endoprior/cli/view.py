"""`endoprior view RUN` and `endoprior view DATA`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..core.checks import InputError
from ..doctor.choice import Wanted
from .devices import on_device
from .parsing import parse
from .progress import say

if TYPE_CHECKING:
    from ..data import FrameSequence
    from ..model.scene import Scene
    from ..training.state import StepReport
    from ..training.trainer import Trainer
    from ..view.server import Viewer
    from ..view.subject import Subject

DEFAULT_PORT = 8080


@dataclass
class View:
    """Look at a trained scene, or at a sequence before training, in a web browser."""

    path: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN|DATA")]]
    """Run folder, or sequence folder."""
    data: Path | None = None
    """Sequence folder of the originals of a run; the one it was trained on if not given."""
    host: str = "127.0.0.1"
    """Address to listen on. Anybody who can reach it sees the scene: there is no password."""
    port: int = DEFAULT_PORT
    """Port to listen on; 0 takes any free one."""
    device: Wanted = "auto"
    """Where to draw a run; auto takes CUDA only where all of it works (`endoprior doctor`)."""


def run(argv: list[str]) -> None:
    """Serve until interrupted."""
    args = parse(View, argv, "view")
    from ..view.guard import check_address

    check_address(args.host, args.port)
    subject, out = open_subject(args.path, args.data, args.device)
    viewer = import_viewer()(subject, host=args.host, port=args.port, out=out)
    say(f"{subject.title}: {viewer.url}  (Ctrl-C ends)")
    viewer.run()


def import_viewer() -> type[Viewer]:
    """The class that serves.

    Raises:
        InputError: viser is not installed.
    """
    try:
        from ..view.server import Viewer
    except ModuleNotFoundError as error:
        raise InputError(f"the viewer: expected the package {error.name}; found none. `pip install viser`.") from None
    return Viewer


@contextmanager
def live_view(port: int | None) -> Iterator[Callable[[StepReport, Trainer], None]]:
    """Yield an `on_step` of `train.train` that shows the scene at 127.0.0.1; one that does nothing if `port` is None.

    Raises:
        InputError: viser is not installed, or the port is taken.
    """
    if port is None:
        yield lambda report, trainer: None
        return
    import_viewer()
    from ..view.guard import check_address
    from ..view.live import LiveView

    check_address("127.0.0.1", port)
    view = LiveView("127.0.0.1", port)
    try:
        yield view
    finally:
        view.close()


def open_subject(path: Path, data: Path | None, device: Wanted = "cpu") -> tuple[Subject, Path | None]:
    """What is at `path`, and the folder its screenshots go to: none for a sequence, whose folder is not ours.

    Args:
        data: sequence folder of a run. device: where a run is drawn.

    Raises:
        InputError: neither a run nor a sequence.
    """
    from ..data import load_sequence
    from ..view.sequence_subject import SequenceSubject

    folder = path.parent if path.name == "scene.safetensors" else path
    if not os.path.isfile(folder / "scene.safetensors"):  # of a name too long for the system pathlib would raise
        if (folder / "config.json").is_file() and (folder / "log.jsonl").is_file():
            hint = "It appears when training is done; `endoprior train --view` shows a scene while it trains."
            raise InputError(f"{folder / 'scene.safetensors'}: expected a trained scene; found none yet. {hint}")
        return SequenceSubject(load_sequence(path)), None
    from ..model.scene import load_scene
    from ..view.scene_subject import SceneSubject

    scene = load_scene(folder)
    originals = _originals(scene, folder, data)
    return SceneSubject(on_device(scene, device, fp16_planes=True), str(folder), originals), folder / "view"


def _originals(scene: Scene, folder: Path, data: Path | None) -> FrameSequence | None:
    """The sequence of a run; None, with a note, if it has gone.

    Raises:
        InputError: `data` was given and does not fit.
    """
    from ..data import load_sequence
    from ..evaluation.scoring import scored_data
    from .evaluate import sequence_of_run

    try:
        sequence = load_sequence(data or sequence_of_run(folder), scored_data(scene.config.data))
    except InputError as error:
        if data:
            raise
        say(f"note: no originals, differences or tools: {error}")
        return None
    if len(sequence) != len(scene.cameras):
        raise InputError(
            f"{sequence.path}: expected {len(scene.cameras)} frames; got {len(sequence)}. Pass the run's own --data."
        )
    return sequence
