"""`endoprior view RUN` and `endoprior view DATA`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..core.shell import command
from ..system.console import say
from .arguments import Help, parse
from .devices import Wanted, on_device
from .paths import open_gaussians, sequence_of

if TYPE_CHECKING:
    from ..training.trainer import StepReport, Trainer
    from ..view.server import Viewer
    from ..view.viewable import Viewable

DEFAULT_PORT = 8080


@dataclass
class View:
    """Show a trained scene, or a sequence before training, in a web browser."""

    path: Path = field(metadata={"place": "RUN|DATA"})
    """Run folder, or sequence folder."""
    data: Path | None = None
    """Sequence folder with the input frames of a run. Default: the one it was trained on."""
    highlights: bool = True
    """`--no-highlights` shows the tissue below the highlights of a run, as other frames show it."""
    host: str = "127.0.0.1"
    """Address to listen on. Other machines reach any but 127.0.0.1, without encryption."""
    port: int = DEFAULT_PORT
    """Port to listen on; 0 uses any free port."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""


HELP = Help(examples=(("RUN",), ("DATA", "--port", "9000")))


def run(argv: list[str]) -> None:
    """Serve until interrupted."""
    args = parse(View, argv, "view", HELP)
    viewer_class = import_viewer()
    from ..view.access_control import check_address, is_open

    check_address(args.host, args.port)
    viewable, out = open_viewable(args.path, args.data, args.device, highlights=args.highlights)
    viewer = viewer_class(viewable, host=args.host, port=args.port, out=out)
    if is_open(args.host):
        say("--host: whoever learns the address below can see and change everything here; nothing is encrypted.")
    say(f"{viewable.title}: {viewer.url}  (Ctrl-C stops)")
    try:
        viewer.run()
    except KeyboardInterrupt:  # the usual way to end it
        say("viewer closed")


def import_viewer() -> type[Viewer]:
    """Import the viewer class.

    Raises:
        InputError: viser is not installed.
    """
    try:
        from ..view.server import Viewer
    except ModuleNotFoundError as error:
        raise input_error(
            "the viewer", f"the package {error.name}", "none", "`pip install -c constraints.txt viser`."
        ) from None
    return Viewer


@contextmanager
def live_view(port: int | None) -> Iterator[Callable[[StepReport, Trainer], None]]:
    """Yield an `on_step` callback that shows the scene at 127.0.0.1. It does nothing if `port` is None.

    Raises:
        InputError: viser is not installed, or the port is in use.
    """
    if port is None:
        yield lambda report, trainer: None
        return
    import_viewer()
    from ..view.access_control import check_address
    from ..view.live import LiveView

    check_address("127.0.0.1", port)
    view = LiveView("127.0.0.1", port)
    try:
        yield view
    finally:
        view.close()


def open_viewable(
    path: Path, data: Path | None, device: Wanted = "cpu", *, highlights: bool = True
) -> tuple[Viewable, Path | None]:
    """Open the run or sequence at `path`. Also returns the folder for its screenshots: None for a sequence.

    Args:
        data: sequence folder of a run.
        device: device that renders a run.
        highlights: False shows a run without them.
    Raises:
        InputError: neither a run nor a sequence; or highlights cannot be taken out of it.
    """
    from ..data import load_sequence
    from ..view.viewable_sequence import ViewableSequence

    file = path if path.suffix == ".safetensors" else path / "scene.safetensors"
    folder = file.parent
    if not os.path.isfile(file):  # pathlib raises for a name that is too long
        if (folder / "config.json").is_file() and (folder / "log.jsonl").is_file():
            again = command("train", "--resume", folder, "--view")
            fix = f"Wait until training is done. To see it before, stop it and run `{again}`."
            raise input_error(file, "a trained scene", "none yet", fix)
        if not highlights:
            raise input_error("--no-highlights", "a run folder", f"{path}, a sequence", "Leave it out.")
        return ViewableSequence(load_sequence(path)), None
    from ..view.viewable_scene import ViewableScene

    scene = open_gaussians(path)
    originals = sequence_of(scene, folder, data, "there are no differences and tools to show")
    scene = on_device(scene, device, fp16_planes=True)
    if not highlights:
        from ..model.highlights import without_highlights

        if originals is None:
            fix = "Name it: `--data FOLDER`."
            raise input_error("--no-highlights", "the sequence of the run", "none", fix)
        scene = without_highlights(scene, originals.training_part)
    return ViewableScene(scene, str(path), originals), folder / "view"
