"""The command line: find the command, run it, and turn every failure into the right exit status.

Exit status: 0 done; 2 bad input or usage, one line on stderr; 1 a failure of ours, with traceback; 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module

from ..core.checks import InputError
from ..system.memory import refuse_small_limits

COMMANDS = {
    "demo": "phantom sequence -> train -> eval -> render, with a summary and pictures",
    "phantom": "write a synthetic surgical sequence with full ground truth",
    "prepare": "write a sequence folder from a video: eyes, borders, depth, tool masks, poses",
    "check": "look at a sequence before training: facts, findings with their fix, one picture",
    "prior": "draw the cue maps and the joint texture prior of each frame",
    "train": "train one scene and score it",
    "eval": "score a trained scene on a split",
    "render": "draw a trained scene: color, depth, side-by-side, video",
    "export": "write open formats: PLY, splat, SPZ, glTF, mesh, points, tracks, depth, video",
    "view": "look at a trained scene, or a sequence before training, in a web browser",
    "doctor": "say whether this machine can use CUDA, and what to install for it",
    "bench": "compare methods on sequences over seeds, under one protocol",
}
"""Name and one-line description; each lives in the module of this package named like it (`eval` in `evaluate`)."""

MODULES = {"eval": "evaluate"}
NO_MEMORY = ("can't allocate memory", "not enough memory", "Insufficient memory", "bad_alloc", "can't start new thread")
"""What torch, OpenCV and the system say when they get none; none of them raises MemoryError."""


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; None takes them from the process.
    Returns:
        The exit status.
    """
    # Torch and Numba each have a pool of threads, and torch's idle ones spin on the cores that Numba's need: drawing
    # and its gradient take three times as long (docs/log.md). Read when torch is first imported; a user's choice stays.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    argv = sys.argv[1:] if argv is None else argv
    if not argv or argv[0] in ("-h", "--help"):
        print(overview())
        return 0
    if argv[0] == "--version":
        from importlib.metadata import version

        print(version("endoprior"))
        return 0
    name, rest = argv[0], argv[1:]
    try:
        if name not in COMMANDS:
            raise InputError(f"{name}: no such command; expected one of {', '.join(COMMANDS)}. Try `endoprior --help`.")
        refuse_small_limits()
        return import_module(f".{MODULES.get(name, name)}", __package__).run(rest) or 0
    except InputError as error:
        print(f"endoprior: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("endoprior: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        if (words := unforeseen(error)) is None:
            raise
        print(f"endoprior: {words}", file=sys.stderr)
        return 2
    return 0


def unforeseen(error: Exception) -> str | None:
    """The line for what no command could foresee, memory and files of the system; None for a failure of ours."""
    whole = " ".join(str(error).split())
    if type(error).__name__ == "OutOfMemoryError":  # torch's, of a GPU: its words begin with the numbers
        return (
            f"expected enough memory of the GPU; got {whole[:160]!r}. Ask for less, such as smaller frames or "
            "--init-budget, or add --device cpu; the last checkpoint of a run is whole, go on with --resume."
        )
    text = whole[-160:]
    if isinstance(error, MemoryError) or any(words in text for words in NO_MEMORY):
        return (
            f"expected enough memory; got {text or 'none'}. Free some, or ask for less, such as smaller frames; the "
            "last checkpoint of a run is whole, go on with --resume."
        )
    if isinstance(error, OSError) and error.filename is not None:
        named = ascii(os.fsdecode(error.filename))[1:-1][-160:]
        return f"{named}: expected a usable file; got {error.strerror}. Check the path, the rights and the disk."
    return None


def overview() -> str:
    """The text of `endoprior --help`."""
    lines = [f"  {name:<9}{about}" for name, about in COMMANDS.items()]
    return "\n".join(
        [
            "usage: endoprior COMMAND ...",
            "",
            "From an endoscope video to a moving 3D model of the tissue, on any CPU. Research use only.",
            "",
            *lines,
            "",
            "`endoprior COMMAND --help` explains every option.",
        ]
    )
