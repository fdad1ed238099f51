"""Named arrays and a description in one safetensors file: whole, versioned, no pickle, equal bytes if equal content."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .atomic import whole_file
from .checks import InputError

if TYPE_CHECKING:
    from torch import Tensor

KEY = "endoprior"
"""The one metadata entry. With several, safetensors would write them in random order, and equal files would differ."""


def save_arrays(path: Path, arrays: Mapping[str, Tensor], about: Mapping[str, Any], file_format: str) -> None:
    """Write tensors and a JSON-able description.

    Args:
        file_format: name and version, such as `endoprior-scene-1`.
    """
    from safetensors.torch import save_file

    text = json.dumps({"format": file_format, **about}, sort_keys=True)
    with whole_file(path) as temporary:
        save_file({name: value.detach().contiguous() for name, value in arrays.items()}, temporary, {KEY: text})


def load_arrays(path: Path, file_format: str, next_step: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_arrays` wrote.

    Args:
        next_step: what to do when the file cannot be used; ends the message.
    Raises:
        InputError: the file is not a safetensors file, or not of this format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as opened:
            about = json.loads((opened.metadata() or {})[KEY])
            found = about["format"]
            if found != file_format:
                raise InputError(f"{path}: expected format {file_format}; got {found!r}. {next_step}")
            return {name: opened.get_tensor(name) for name in opened.keys()}, about
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected a file of format {file_format}; got {error!r}. {next_step}") from None


def part(arrays: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The arrays whose names start with `prefix`, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
