"""`endoprior view RUN` and `endoprior view DATA`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..core.shell import command
from ..data import load_sequence
from ..data.files import or_neighbor
from ..data.reading import kind_of
from ..system.console import say
from .arguments import Command
from .devices import Wanted, on_device
from .paths import open_gaussians, sequence_if_there

if TYPE_CHECKING:
    from ..training.trainer import Observer
    from ..view.viewable_sequence import Viewable


@dataclass
class View(Command):
    """Show a trained scene, or a sequence before training, in a web browser."""

    path: Path = field(metadata={"place": "RUN|DATA"})
    """Run folder, or sequence folder."""
    data: Path | None = None
    """Sequence folder with the input frames of a run. Default: the one it was trained on."""
    highlights: bool = True
    """Highlights of a run; without them, the tissue below, as other frames show it."""
    host: str = "127.0.0.1"
    """Address to listen on. Other machines reach any but 127.0.0.1, without encryption."""
    port: int = 8080
    """Port to listen on; 0 uses any free port."""
    allow_host: tuple[str, ...] = field(default=(), metadata={"metavar": "NAME"})
    """Other names of this machine in the address of the page: that of a proxy which keeps it."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""

    examples = ("RUN", "DATA --port 9000")

    def execute(self) -> None:
        """Serve until interrupted."""
        from ..view.addresses import check_address, check_names, is_open
        from ..view.server import Viewer

        check_names(self.allow_host)
        check_address(self.host, self.port)
        viewable, out = open_viewable(self.path, self.data, self.device, highlights=self.highlights)
        viewer = Viewer(viewable, host=self.host, port=self.port, out=out, names=self.allow_host)
        if is_open(self.host):
            say("--host: whoever learns the address below can see and change everything here; nothing is encrypted.")
        say(f"{viewable.title}: {viewer.url}  (Ctrl-C stops)")
        try:
            viewer.run()
        except KeyboardInterrupt:  # the usual way to end it
            say("viewer closed")


@contextmanager
def live_view(port: int | None) -> Iterator[Observer]:
    """Yield an `on_step` callback that shows the scene at 127.0.0.1; it does nothing if `port` is None."""
    if port is None:
        yield lambda _report, _trainer: None
        return
    from ..view.addresses import check_address
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
        data, device, highlights: of a run; see `View`.
    """
    from ..view.viewable_sequence import ViewableSequence

    file = path if path.suffix == ".safetensors" else path / "scene.safetensors"
    folder = file.parent
    if not os.path.isfile(file):  # pathlib raises for a name that is too long
        if (folder / "config.json").is_file() and (folder / "log.jsonl").is_file():
            fix = "Wait until training is done, or stop it and resume it with `endoprior train --resume RUN --view`."
            raise input_error(file, "a trained scene", "none yet", fix)
        if not highlights:
            raise input_error("--no-highlights", "a run folder", f"{path}, a sequence", "Leave it out.")
        if kind_of(path) == "nothing":
            fix = or_neighbor(f"Correct the path, or make a run: `{command('train', 'DATA', path)}`.", path)
            raise input_error(path, "a run folder or a sequence folder", "no such folder", fix)
        return ViewableSequence(load_sequence(path)), None
    from ..model.scene import with_gaussians
    from ..view.viewable_scene import ViewableScene

    scene = open_gaussians(path)
    originals = sequence_if_there(scene, folder, data, "there are no differences and tools to show")
    scene = with_gaussians(on_device(scene, device, fp16_planes=True), path)
    if not highlights:
        from ..model.highlights import without_highlights

        if originals is None:
            raise input_error("--no-highlights", "the sequence of the run", "none", "Name it: `--data FOLDER`.")
        scene = without_highlights(scene, originals.training_part)
    return ViewableScene(scene, str(path), originals), folder / "view"
