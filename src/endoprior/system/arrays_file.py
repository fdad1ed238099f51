"""Named arrays and metadata in one safetensors file: atomic, versioned, without pickle, deterministic bytes.

A file may be untrusted. Its header is compared with its size and with a schema before any array is read, because
kernels trust shapes and types. Then all values are checked to be finite, and compared with the digest in the metadata.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..core.checks import InputError, input_error
from .atomic import whole_file
from .plugins import MissingPlugin

if TYPE_CHECKING:
    from torch import Tensor

KEY = "endoprior"
"""The single metadata entry. With several, safetensors writes them in random order, and equal files would differ."""
DIGEST = "digest"
"""The entry of the metadata with the digest of all others and of the arrays. Earlier versions wrote none."""
MAX_HEADER, MAX_FILE = 2**20, 2**36
"""bytes. Normal headers (names, shapes, metadata) have a few thousand; a sparse file could claim any size."""
DTYPES = {"float32": "F32", "float64": "F64", "int64": "I64", "uint8": "U8"}
"""Names of the types in the file."""


@dataclass(frozen=True)
class ArraySpec:
    """Type and shape of one array in a file."""

    dtype: str
    """One of the keys of `DTYPES`."""
    shape: tuple[int | str, ...]
    """A letter is one size, the same in all arrays of a file."""

    def __str__(self) -> str:
        return f"{self.dtype} ({', '.join(map(str, self.shape))})"


Schema = Callable[[dict[str, Any]], Mapping[str, ArraySpec]]
"""Maps the metadata of a file to its arrays: all of them and no others."""


def save_arrays(path: Path, arrays: Mapping[str, Tensor], about: Mapping[str, Any], file_format: str) -> None:
    """Write tensors and JSON metadata, with a digest of both.

    Args:
        file_format: name and version, such as `endoprior-scene-1`.
    """
    from safetensors.torch import save_file

    stored = {name: value.detach().cpu().contiguous() for name, value in arrays.items()}
    facts = {"format": file_format, **about}
    text = json.dumps({**facts, DIGEST: _digest(stored, facts)}, sort_keys=True)
    with whole_file(path) as temporary:
        # The library writes to a temporary sibling of its own, which would remain after a kill.
        staging = temporary.with_name(f"{temporary.name}.staging")
        try:
            staging.mkdir()
            save_file(stored, staging / "arrays", {KEY: text})
            (staging / "arrays").replace(temporary)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def load_arrays(path: Path, formats: Mapping[str, Schema], fix: str) -> tuple[dict[str, Tensor], dict]:
    """Read a file written by `save_arrays`.

    Args:
        formats: the formats that can be used, and the arrays that each requires.
        fix: what to do if the file cannot be used; ends the error message.
    Returns:
        The arrays, which match the schema and are finite; and the metadata, with the `format` in it.
    Raises:
        InputError: not a safetensors file, another format, arrays that do not match the schema, or bits that changed
            since the file was written.
    """
    from safetensors import SafetensorError, safe_open

    expected = " or ".join(formats)
    with rejecting(path, f"a file of format {expected}", fix, SafetensorError, AttributeError):
        _check_size(path)
        with safe_open(path, "pt") as opened:
            about = json.loads((opened.metadata() or {})[KEY], parse_constant=_reject_constant)
            digest, found = about.pop(DIGEST, None), about["format"]
            if not isinstance(found, str) or found not in formats:
                raise input_error(path, f"format {expected}", f"{found!r:.80}", fix)
            headers = {name: opened.get_slice(name) for name in opened.keys()}
            stored = {name: (header.get_dtype(), tuple(header.get_shape())) for name, header in headers.items()}
            _match(stored, formats[found](about))
            # Copies: the library's tensors lie in the mapped file, and Windows does not replace a mapped file.
            arrays = {name: opened.get_tensor(name).clone() for name in stored}
        for name, value in arrays.items():  # `aminmax` takes one pass and no memory, and propagates NaN
            is_float = value.is_floating_point() and value.numel()
            if is_float and not all(bool(end.isfinite()) for end in value.aminmax()):
                raise InputError(f"expected finite numbers in {name}, got NaN or infinity")
        if digest is not None and digest != _digest(arrays, about):
            raise InputError("expected the bits that were written, got others: the file was damaged or changed")
        return arrays, about


def load_facts(path: Path, file_format: str, fix: str) -> dict[str, Any]:
    """The metadata alone of a file written by `save_arrays`; the digest is not compared. See `load_arrays`."""
    from safetensors import SafetensorError, safe_open

    with rejecting(path, f"a file of format {file_format}", fix, SafetensorError, AttributeError):
        _check_size(path)
        with safe_open(path, "pt") as opened:
            about = json.loads((opened.metadata() or {})[KEY], parse_constant=_reject_constant)
        if about["format"] != file_format:
            raise input_error(path, f"format {file_format}", f"{about['format']!r:.80}", fix)
        return about


@contextmanager
def rejecting(path: Path, expected: str, fix: str, *others: type[Exception]) -> Iterator[None]:
    """Convert all errors that a wrong file can cause, including `others`, to an InputError about the file.

    An InputError passes; the file name is added if it is missing. A MissingPlugin keeps its fix.
    """
    try:
        yield
    except MissingPlugin as error:
        raise MissingPlugin(f"{path}: {error}") from None
    except InputError as error:
        if str(error).startswith(f"{path}:"):
            raise
        problem = str(error).split(". Fix: ")[0].removesuffix(".")
        raise InputError(f"{path}: {problem}. Fix: {fix}") from None
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, OverflowError, RecursionError, *others) as error:
        got = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise input_error(path, expected, got, fix) from None


def part(arrays: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The arrays whose names start with `prefix`, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def _check_size(path: Path) -> None:
    """Reject anything but a regular file, and a header or file that is too large."""
    facts = path.stat()
    if not stat.S_ISREG(facts.st_mode):
        raise InputError("expected a plain file, got a folder, a pipe or a device")
    with open(path, "rb") as file:
        header = int.from_bytes(file.read(8), "little")
    for name, size, largest in (("header", header, MAX_HEADER), ("file", facts.st_size, MAX_FILE)):
        if size > largest:
            raise InputError(f"expected a {name} of at most {largest:,} bytes, got {size:,}")


def _reject_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} in the metadata, which is not JSON")


def _match(stored: Mapping[str, tuple[str, tuple[int, ...]]], schema: Mapping[str, ArraySpec]) -> None:
    """Reject arrays that are not exactly those of the schema."""
    sizes: dict[str, int] = {}
    if unknown := sorted(stored.keys() - schema.keys()):
        raise InputError(f"expected no array {unknown[0]!r:.80}, got one")
    for name, spec in schema.items():
        if name not in stored:
            raise InputError(f"expected an array {name}: {spec}, got none")
        dtype, shape = stored[name]
        same = len(shape) == len(spec.shape) and all(
            (sizes.setdefault(want, got) if isinstance(want, str) else want) == got
            for want, got in zip(spec.shape, shape, strict=True)
        )
        if dtype != DTYPES[spec.dtype] or not same:
            bound = ", ".join(f"{letter} = {size}" for letter, size in sizes.items() if letter in spec.shape)
            known = f" with {bound}" if bound else ""
            raise InputError(f"expected the array {name} to be {spec}{known}, got {dtype} {shape}")


def _digest(arrays: Mapping[str, Tensor], about: Mapping[str, Any]) -> str:
    """SHA-256 of the metadata and of the name, type, shape and bytes of each array."""
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name, value in sorted(arrays.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.numpy().reshape(-1).view("u1").data)
    return digest.hexdigest()
