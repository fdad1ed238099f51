"""Load a network of the Hugging Face hub: from a folder, from the library's cache, or by download.

This module uses the internet only if the user names a model that is not in the cache. It says so before it downloads.
"""

from __future__ import annotations

from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from ..core.checks import input_error
from ..core.shell import install_command
from ..system.console import say

FILES = ("config.json", "model.safetensors")  # files of a model. Pickled weights are not read.
ANSWER_S = 10.0  # longest time to wait for the size and the license of a model


def load_network(name: str, default: str, class_name: str, what: str, *, option: str, extra: str) -> Any:
    """A network of the transformers library, in evaluation mode, on the CPU.

    Args:
        name: a folder, or a name on the hub.
        default: the usual name on the hub, for error messages.
        class_name: of the library.
        what: the files must hold, such as `a SAM 2 video model`.
        option: with its value, that needs it.
        extra: the optional part that brings the library.
    Raises:
        InputError: the library or the files cannot be had, or the files hold another network.
    """
    if find_spec("transformers") is None:
        raise input_error(option, "the transformers package", "none", f"`{install_command(extra)}`.")
    transformers = _import_transformers(option, extra, class_name)
    files = " and ".join(FILES)
    folder = _find_model(name, f"Download {files} of {default} on another machine, then `{option}:FOLDER`.")
    try:
        network, report = getattr(transformers, class_name).from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # the library raises many types for a wrong file
        raise input_error(name, what, _first_line(error), "Choose another model.") from None
    if missing := sorted(report["missing_keys"]):
        got = f"no weights for {missing[0]} and {len(missing) - 1} more"
        raise input_error(name, what, got, "Choose another model.")
    return network.eval()


def _find_model(name: str, hint: str) -> Path:
    """The folder with a model's files; downloads them if `name` is a hub model that is not cached."""
    folder, wanted = Path(name).expanduser(), " and ".join(FILES)
    if folder.is_dir():
        if missing := [file for file in FILES if not (folder / file).is_file()]:
            raise input_error(folder, f"a model's {wanted}", f"no {missing[0]}", "Download the model again.")
        return folder
    if name.count("/") != 1 or name.startswith((".", "/", "~")):
        raise input_error(name, "a model folder or a name of the Hugging Face hub", "neither", hint)
    from huggingface_hub import snapshot_download

    # Request only the files that are needed; the loader of transformers requests more.
    with suppress(Exception):
        cached = Path(snapshot_download(name, allow_patterns=list(FILES), local_files_only=True))
        if all((cached / file).is_file() for file in FILES):
            return cached
    say(f"downloading {name}{_size_and_license(name)}")
    try:
        fetched = Path(snapshot_download(name, allow_patterns=list(FILES)))
    except Exception as error:  # the hub client's, its transport's and the system's errors share no other base
        reason = _first_line(error).removeprefix("Got: ")
        raise input_error(name, "a model in the cache or a download", reason, hint) from None
    if not all((fetched / file).is_file() for file in FILES):
        raise input_error(name, f"a model's {wanted}", "other files", "Choose a model in this format.")
    return fetched


def _import_transformers(option: str, extra: str, class_name: str) -> ModuleType:
    """The transformers library, in which the class can be imported; InputError if it cannot, or is too old."""
    if find_spec("torchvision") is not None:
        # transformers imports torchvision if it is installed, even one that does not fit the installed torch.
        from ..evaluation.networks import import_torchvision
        from ..evaluation.score import ScoreUnavailable

        with suppress(ScoreUnavailable):
            import_torchvision()
    try:
        import transformers

        getattr(transformers, class_name)
    except Exception as error:  # the library raises what the packages that it imports raise, in sentences of its own
        while error.__cause__:
            error = error.__cause__
        # An old or unfit torchvision is the usual reason.
        fix = f"`{install_command(extra)} torchvision`."
        raise input_error(option, "transformers that can be imported", _first_line(error), fix) from None
    return transformers


def _first_line(error: BaseException) -> str:
    """What an error says, on one line; the name of its type if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _size_and_license(name: str) -> str:
    """`: 156 MB, license apache-2.0`, or empty if the hub does not tell."""
    with suppress(Exception):
        from huggingface_hub import HfApi

        facts = HfApi().model_info(name, files_metadata=True, timeout=ANSWER_S)
        size = sum(each.size or 0 for each in facts.siblings or [] if each.rfilename in FILES)
        licenses = [tag.partition(":")[2] for tag in facts.tags or [] if tag.startswith("license:")]
        return f": {size / 1e6:.0f} MB, license {', '.join(licenses) or 'unknown'}"
    return ""
