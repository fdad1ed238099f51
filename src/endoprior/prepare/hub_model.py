"""Find the files of a network of the Hugging Face hub: in a folder, in the library's cache, or by download.

This module uses the internet only if the user names a model that is not in the cache. It says so before it downloads.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from ..core.checks import input_error
from ..core.shell import install_command
from ..system.console import say

FILES = ("config.json", "model.safetensors")
"""Files of a model. Pickled weights are not read."""
ANSWER_S = 10.0
"""Longest time to wait for the size and the license of a model."""


def find_model(name: str, hint: str, files: Sequence[str] = FILES) -> Path:
    """The folder with a model's files; downloads them if `name` is a hub model that is not cached.

    Args:
        hint: how to get the model without a network, for error messages.
        files: the files that are needed.
    Raises:
        InputError: the files cannot be had.
    """
    folder, wanted = Path(name).expanduser(), " and ".join(files)
    if folder.is_dir():
        missing = [file for file in files if not (folder / file).is_file()]
        if missing:
            raise input_error(folder, f"a model's {wanted}", f"no {missing[0]}", "Download the model again.")
        return folder
    if name.count("/") != 1 or name.startswith((".", "/", "~")):
        raise input_error(name, "a model folder or a name of the Hugging Face hub", "neither", hint)
    from huggingface_hub import snapshot_download

    # Request only the files that are needed; the loader of transformers requests more.
    with suppress(Exception):
        cached = Path(snapshot_download(name, allow_patterns=list(files), local_files_only=True))
        if all((cached / file).is_file() for file in files):
            return cached
    say(f"downloading {name}{_size_and_license(name, files)}")
    try:
        fetched = Path(snapshot_download(name, allow_patterns=list(files)))
    except Exception as error:  # the hub client's, its transport's and the system's errors share no other base
        reason = first_line(error).removeprefix("Got: ")
        raise input_error(name, "a model in the cache or a download", reason, hint) from None
    if not all((fetched / file).is_file() for file in files):
        raise input_error(name, f"a model's {wanted}", "other files", "Choose a model in this format.")
    return fetched


def import_transformers(option: str, extra: str, name: str) -> ModuleType:
    """The transformers library, in which the class `name` can be imported.

    Args:
        option: that needs it, for error messages.
        extra: the optional part that brings it.
    Raises:
        InputError: it cannot be imported, or is too old to have the class.
    """
    if find_spec("torchvision") is not None:
        # transformers imports torchvision if it is installed, even one that does not fit the installed torch.
        from ..evaluation.metrics.torchvision_compat import import_torchvision
        from ..evaluation.metrics.weights import ScoreUnavailable

        with suppress(ScoreUnavailable):
            import_torchvision()
    try:
        import transformers

        getattr(transformers, name)
    except Exception as error:  # the library raises what the packages that it imports raise, in sentences of its own
        while error.__cause__:
            error = error.__cause__
        # An old or unfit torchvision is the usual reason.
        fix = f"`{install_command(extra)} torchvision`."
        raise input_error(option, "transformers that can be imported", first_line(error), fix) from None
    return transformers


def first_line(error: BaseException) -> str:
    """What an error says, on one line; the name of its type if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _size_and_license(name: str, files: Sequence[str]) -> str:
    """`: 156 MB, license apache-2.0`, or empty if the hub does not tell."""
    with suppress(Exception):
        from huggingface_hub import HfApi

        facts = HfApi().model_info(name, files_metadata=True, timeout=ANSWER_S)
        size = sum(each.size or 0 for each in facts.siblings or [] if each.rfilename in files)
        licenses = [tag.partition(":")[2] for tag in facts.tags or [] if tag.startswith("license:")]
        return f": {size / 1e6:.0f} MB, license {', '.join(licenses) or 'unknown'}"
    return ""
