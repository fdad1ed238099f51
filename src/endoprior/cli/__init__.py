"""The command line: find the command, run it, and convert every failure to an exit status.

Exit status: 0 done; 2 bad input or usage, one line on stderr; 1 a bug, with traceback; 130 interrupted, by Ctrl-C,
SIGTERM or SIGHUP.
"""

from __future__ import annotations

import io
import os
import sys
from importlib import import_module
from typing import Any

from ..core.checks import InputError, input_error, or_did_you_mean
from ..core.kernel_folder import without_kernel_cache
from ..system.atomic import DISK_ERRORS
from ..system.console import complain, complete_streams, say
from ..system.installation import docs_folder
from ..system.memory import reject_small_limits
from ..system.plugins import Registry
from ..system.signals import all_interrupt
from ..system.surroundings import reject_surroundings, set_up_process

COMMANDS = {
    "run": ("run", "from a video to a model to look at: prepare, check, train, score, video, player"),
    "demo": ("phantom", "phantom sequence -> train -> eval -> render, with a summary and images"),
    "phantom": ("phantom", "write a synthetic surgical sequence with full ground truth"),
    "scan": ("scan", "look through a whole video: which segments can become a model, and why the rest not"),
    "sample": ("phantom", "write a made-up stereo video with calibration, to try `run` and `prepare`"),
    "prepare": ("prepare", "write a sequence folder from a video: rectified frames, depth, tool masks, poses"),
    "masks": ("masks", "find the tools in a sequence folder and write their masks"),
    "poses": ("prepare", "find the camera path of a sequence folder and write its poses"),
    "scale": ("prepare", "bring relative depth to mm, by a known length or an instrument's diameter"),
    "check": ("check", "check a sequence before training: properties, problems with their fix, a figure"),
    "prior": ("check", "write the cue maps and the joint texture prior of each frame"),
    "train": ("train", "train one scene and score it"),
    "eval": ("evaluate", "score a trained scene on a split, or the images of another program"),
    "render": ("render", "render a trained scene: color, depth, side-by-side, video"),
    "export": ("export", "write open formats: PLY, splat, SPZ, glTF, mesh, points, tracks, depth, video"),
    "view": ("view", "show a trained scene, or a sequence before training, in a web browser"),
    "doctor": ("doctor", "report versions, and try the backends that could render on this computer"),
    "batch": ("batch", "do `run` for many videos and sequence folders, here or on a Ray cluster"),
    "completion": ("completion", "print a script that lets the Tab key complete commands and options"),
    "plugins": ("doctor", "list what other packages add, and what is built in: datasets, methods, scores, ..."),
}
"""Name -> module of this package with the class of that name (`eval`: `Eval`), and one-line description."""
REGISTRY: Registry[Any] = Registry(
    "commands",
    "a module with ABOUT, its one-line description, and run(arguments)",
    lambda found: "" if callable(getattr(found, "run", None)) and hasattr(found, "ABOUT") else "something else",
    modules=tuple(COMMANDS),
    load_module=lambda name: getattr(import_module(f".{COMMANDS[name][0]}", __package__), name.capitalize()),
)
"""The classes of the commands above, and modules of other packages."""
NO_MEMORY = ("can't allocate memory", "not enough memory", "Insufficient memory", "bad_alloc", "can't start new thread")
"""Messages of torch, OpenCV and the system when memory runs out; they do not raise MemoryError."""
RESUMABLE = "The last checkpoint of a run is complete; resume with `endoprior train --resume RUN`."


def main(argv: list[str] | None = None) -> int:
    """Run one command and return the exit status.

    Args:
        argv: arguments without the program's name; None takes them from the process.
    """
    set_up_process()
    complete_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # write characters that its encoding lacks as \xNN
        sys.stdout.reconfigure(errors="backslashreplace")
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    try:
        return _run(name, rest)
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


def _run(name: str, rest: list[str]) -> int:
    if name in ("-h", "--help"):
        say(overview())
        return 0
    if name == "--version":
        from importlib.metadata import version

        say(version("endoprior"))
        return 0
    if name not in (names := REGISTRY.names()):
        fix = or_did_you_mean("`endoprior --help` explains each.", name, names, "endoprior ")
        raise input_error(name, f"one of {', '.join(names)}", "no such command", fix)
    reject_small_limits()
    reject_surroundings()
    with all_interrupt():
        command = REGISTRY.load(name)
        return (command.from_words(rest).execute() if name in COMMANDS else command.run(rest)) or 0


def system_failure(error: Exception) -> str | None:
    """The error message for failures of memory, the file system and what surrounds us; None for a bug."""
    if no_cache := without_kernel_cache(error):
        return str(no_cache)
    whole = " ".join(str(error).split())
    if type(error).__name__ == "OutOfMemoryError":  # raised by torch for a GPU; its message starts with the numbers
        fix = "Use smaller frames, fewer --gaussians or --device cpu"
        return f"expected enough GPU memory, got {whole[:160]!r}. Fix: {fix}. {RESUMABLE}"
    text = whole[-160:]
    if isinstance(error, MemoryError) or any(words in text for words in NO_MEMORY):
        return f"expected enough memory, got {text or 'none'}. Fix: Free memory, or use smaller frames. {RESUMABLE}"
    if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK_ERRORS):
        name = error.filename
        name = os.fsdecode(name) if isinstance(name, str | bytes) else "the disk or network drive"
        named = ascii(name)[1:-1][-160:]
        return f"{named}: expected a usable file, got {error.strerror}. Fix: Check the path, permissions and disk."
    return None


def descriptions() -> dict[str, str]:
    """What each command does, by name; those of other packages last."""
    ours = {name: about for name, (_, about) in COMMANDS.items()}
    return ours | {name: module.ABOUT for name, module in REGISTRY.usable()}


def overview() -> str:
    """The text of `endoprior --help`."""
    lines = "\n".join(f"  {name:<12}{about}" for name, about in descriptions().items())
    return (
        "usage: endoprior COMMAND ...\n\n"
        "From an endoscope video to a moving 3D model of the tissue, on any CPU. Research use only.\n\n"
        f"{lines}\n\n"
        "`endoprior COMMAND --help` shows what most users need, `--help-all` every option.\n"
        f"Pages that messages name are in {docs_folder()}"
    )
