"""Named arrays and a description in one safetensors file: whole, versioned, no pickle, equal bytes if equal content.

A file may come from a stranger. What it claims is compared with its size and with what must be in it before any array
is read, because kernels trust shapes and types; then every number is looked at once.
"""

from __future__ import annotations

import json
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.checks import InputError
from .atomic import whole_file

if TYPE_CHECKING:
    from torch import Tensor

KEY = "endoprior"
"""The one metadata entry. With several, safetensors would write them in random order, and equal files would differ."""
LARGEST_HEADER = 2**20
"""Bytes of names, shapes and description; ours have some thousands."""
LARGEST_FILE = 2**36
"""Bytes; a file of holes costs its maker nothing."""
DTYPES = {"float32": "F32", "float64": "F64", "int64": "I64", "uint8": "U8"}
"""What types are called in the file."""


@dataclass(frozen=True)
class ArraySpec:
    """What one array of a file must be."""

    dtype: str
    """One of the keys of `DTYPES`."""
    shape: tuple[int | str, ...]
    """A letter stands for one size in all arrays of a file."""

    def __str__(self) -> str:
        return f"{self.dtype} ({', '.join(map(str, self.shape))})"


Schema = Callable[[dict[str, Any]], Mapping[str, ArraySpec]]
"""From the description of a file to the arrays that must be in it, all of them and no others."""


def save_arrays(path: Path, arrays: Mapping[str, Tensor], about: Mapping[str, Any], file_format: str) -> None:
    """Write tensors and a JSON-able description.

    Args:
        file_format: name and version, such as `endoprior-scene-1`.
    """
    from safetensors.torch import save_file

    text = json.dumps({"format": file_format, **about}, sort_keys=True)
    with whole_file(path) as temporary:
        # The library writes beside the file it is told, under a name of its own choice that a kill would leave there.
        staging = temporary.with_name(f"{temporary.name}.staging")
        staging.mkdir()
        try:
            file = staging / "arrays"
            save_file({name: value.detach().cpu().contiguous() for name, value in arrays.items()}, file, {KEY: text})
            file.replace(temporary)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def load_arrays(path: Path, file_format: str, schema: Schema, next_step: str) -> tuple[dict[str, Tensor], dict]:
    """Read what `save_arrays` wrote.

    Args:
        schema: what must be in it.
        next_step: what to do when the file cannot be used; ends the message.
    Returns:
        The arrays, of the types and shapes demanded, all numbers finite; and the description.
    Raises:
        InputError: the file is not a safetensors file, or not of this format, or its arrays are not as demanded.
    """
    from safetensors import SafetensorError, safe_open

    with rejecting(path, f"a file of format {file_format}", next_step, SafetensorError):
        _check_size(path)
        with safe_open(path, "pt") as opened:
            about = _strict_json((opened.metadata() or {})[KEY])
            found = about["format"]
            if found != file_format:
                raise InputError(f"{path}: expected format {file_format}; got {found!r:.80}. {next_step}")
            headers = {name: opened.get_slice(name) for name in opened.keys()}
            stored = {name: (header.get_dtype(), tuple(header.get_shape())) for name, header in headers.items()}
            _match(stored, schema(about))
            arrays = {name: opened.get_tensor(name) for name in stored}
        for name, value in arrays.items():
            _demand_finite(name, value)
        return arrays, about


@contextmanager
def rejecting(path: Path, expected: str, next_step: str, *others: type[Exception]) -> Iterator[None]:
    """Turn whatever a wrong file provokes in here, `others` besides the usual errors, into one line about it.

    Raises:
        InputError: in place of those errors; one that says what is wrong passes, and the file's name is added.
    """
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{path}:"):
            raise
        raise InputError(f"{path}: {error} {next_step}") from None
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, OverflowError, RecursionError, *others) as error:
        raise InputError(f"{path}: expected {expected}; got {_one_line(error)}. {next_step}") from None


def part(arrays: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The arrays whose names start with `prefix`, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def _check_size(path: Path) -> None:
    """Refuse what is no plain file, and a header or a file too large to be one of ours."""
    facts = path.stat()
    if not stat.S_ISREG(facts.st_mode):
        raise InputError("expected a plain file; got a folder, a pipe or a device.")
    with open(path, "rb") as file:
        header = int.from_bytes(file.read(8), "little")
    for name, size, largest in (("header", header, LARGEST_HEADER), ("file", facts.st_size, LARGEST_FILE)):
        if size > largest:
            raise InputError(f"expected a {name} of at most {largest:,} bytes; got {size:,}.")


def _strict_json(text: str) -> dict[str, Any]:
    """A JSON object; NaN and infinity, which are no JSON, are refused."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} in the description")

    found = json.loads(text, parse_constant=refuse)
    if not isinstance(found, dict):
        raise ValueError("a description that is no object")
    return found


def _match(stored: Mapping[str, tuple[str, tuple[int, ...]]], schema: Mapping[str, ArraySpec]) -> None:
    """Refuse arrays that are not exactly those of the schema."""
    sizes: dict[str, int] = {}
    if strange := sorted(stored.keys() - schema.keys()):
        raise InputError(f"expected no array {strange[0]!r:.80}; got one.")
    for name, spec in schema.items():
        if name not in stored:
            raise InputError(f"expected an array {name}: {spec}; got none.")
        dtype, shape = stored[name]
        same = len(shape) == len(spec.shape) and all(
            (sizes.setdefault(want, got) if isinstance(want, str) else want) == got
            for want, got in zip(spec.shape, shape, strict=True)
        )
        if dtype != DTYPES[spec.dtype] or not same:
            bound = ", ".join(f"{letter} = {size}" for letter, size in sizes.items() if letter in spec.shape)
            known = f" with {bound}" if bound else ""
            raise InputError(f"expected the array {name} to be {spec}{known}; got {dtype} {shape}.")


def _demand_finite(name: str, value: Tensor) -> None:
    """Refuse NaN and infinity. Smallest and largest number take one pass and no memory, and NaN is both."""
    if value.is_floating_point() and value.numel() and not all(bool(end.isfinite()) for end in value.aminmax()):
        raise InputError(f"expected finite numbers in {name}; got NaN or infinity.")


def _one_line(error: Exception) -> str:
    """The kind of an error and what it says, short."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
