"""The command line: find the command, run it, and convert every failure to an exit status.

Exit status: 0 done; 2 bad input or usage, one line on stderr; 1 a bug, with traceback; 130 interrupted, by Ctrl-C,
SIGTERM or SIGHUP.
"""

from __future__ import annotations

import io
import os
import sys
from importlib import import_module

from ..core.checks import InputError, input_error
from ..system.atomic import DISK_ERRORS
from ..system.console import complain, complete_streams, say
from ..system.installation import docs_folder
from ..system.memory import reject_small_limits
from ..system.plugins import Registry
from ..system.signals import all_interrupt
from ..system.surroundings import reject_surroundings, set_library_variables

COMMANDS = {
    "run": "from a video to a model to look at: prepare, check, train, score, video, player",
    "demo": "phantom sequence -> train -> eval -> render, with a summary and pictures",
    "phantom": "write a synthetic surgical sequence with full ground truth",
    "prepare": "write a sequence folder from a video: rectified frames, depth, tool masks, poses",
    "masks": "find the tools in a sequence folder and write their masks",
    "poses": "find the camera path of a sequence folder and write its poses",
    "check": "check a sequence before training: properties, problems with their fix, a figure",
    "prior": "write the cue maps and the joint texture prior of each frame",
    "train": "train one scene and score it",
    "eval": "score a trained scene on a split, or the images of another program",
    "render": "render a trained scene: color, depth, side-by-side, video",
    "export": "write open formats: PLY, splat, SPZ, glTF, mesh, points, tracks, depth, video",
    "view": "show a trained scene, or a sequence before training, in a web browser",
    "doctor": "report versions, and try the backends that could render on this computer",
    "batch": "do `run` for many videos and sequence folders, here or on a Ray cluster",
    "plugins": "list what other packages add, and what is built in: datasets, methods, scores, ...",
}
"""Name and one-line description. Each command is a module of this package with the same name (`eval`: `evaluate`)."""

MODULES = {"eval": "evaluate"}
REGISTRY = Registry(
    "commands",
    "a module with ABOUT, its one-line description, and run(arguments)",
    lambda found: "" if callable(getattr(found, "run", None)) and hasattr(found, "ABOUT") else "something else",
    modules=tuple(COMMANDS),
    load_module=lambda name: import_module(f".{MODULES.get(name, name)}", __package__),
)
"""The commands above, and those of other packages."""
NO_MEMORY = ("can't allocate memory", "not enough memory", "Insufficient memory", "bad_alloc", "can't start new thread")
"""Messages of torch, OpenCV and the system when memory runs out; they do not raise MemoryError."""


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; None takes them from the process.
    Returns:
        The exit status.
    """
    set_library_variables()
    complete_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # write characters that its encoding lacks as \xNN
        sys.stdout.reconfigure(errors="backslashreplace")
    argv = sys.argv[1:] if argv is None else argv
    if not argv or argv[0] in ("-h", "--help"):
        say(overview())
        return 0
    if argv[0] == "--version":
        from importlib.metadata import version

        say(version("endoprior"))
        return 0
    name, rest = argv[0], argv[1:]
    try:
        if name not in (names := REGISTRY.names()):
            fix = "`endoprior --help` explains each."
            raise input_error(name, f"one of {', '.join(names)}", "no such command", fix)
        reject_small_limits()
        reject_surroundings()
        with all_interrupt():
            return REGISTRY.load(name).run(rest) or 0
    except InputError as error:
        complain(f"endoprior: {' '.join(str(error).split())}")
        return 2
    except KeyboardInterrupt:
        complain("endoprior: interrupted")
        return 130
    except Exception as error:
        if (words := system_failure(error)) is None:
            raise
        complain(f"endoprior: {words}")
        return 2


def system_failure(error: Exception) -> str | None:
    """The error message for failures of memory and the file system; None for a bug."""
    whole = " ".join(str(error).split())
    if type(error).__name__ == "OutOfMemoryError":  # raised by torch for a GPU; its message starts with the numbers
        return (
            f"expected enough GPU memory, got {whole[:160]!r}. Fix: Use smaller frames, fewer --gaussians or "
            "--device cpu. The last checkpoint of a run is complete; resume with `endoprior train --resume RUN`."
        )
    text = whole[-160:]
    if isinstance(error, MemoryError) or any(words in text for words in NO_MEMORY):
        return (
            f"expected enough memory, got {text or 'none'}. Fix: Free memory, or use smaller frames. The last "
            "checkpoint of a run is complete; resume with `endoprior train --resume RUN`."
        )
    if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK_ERRORS):
        is_named = isinstance(error.filename, str | bytes)
        name = os.fsdecode(error.filename) if is_named else "the disk or network drive"
        named = ascii(name)[1:-1][-160:]
        return f"{named}: expected a usable file, got {error.strerror}. Fix: Check the path, permissions and disk."
    return None


def descriptions() -> dict[str, str]:
    """What each command does, by name; those of other packages last."""
    return COMMANDS | {name: module.ABOUT for name, module in REGISTRY.usable()}


def overview() -> str:
    """The text of `endoprior --help`."""
    lines = [f"  {name:<9}{about}" for name, about in descriptions().items()]
    return "\n".join(
        [
            "usage: endoprior COMMAND ...",
            "",
            "From an endoscope video to a moving 3D model of the tissue, on any CPU. Research use only.",
            "",
            *lines,
            "",
            "`endoprior COMMAND --help` shows what most users need, `--help-all` every option.",
            f"Pages that messages name are in {docs_folder()}",
        ]
    )
