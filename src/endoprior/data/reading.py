"""Read files of users: bytes, text, arrays, YAML, JSON and tables.

Regular files only, of bounded size; nothing in them is executed. A few lines of YAML with nested anchors can stand for
billions of entries, and nesting can exhaust the stack. All readers raise InputError for a file that is missing,
unreadable, no regular file (a pipe could block forever), too large, or of another kind.
"""

from __future__ import annotations

import io
import json
import math
import re
import stat
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from lzma import LZMAError
from pathlib import Path
from typing import Any, Literal, get_origin
from zipfile import BadZipFile, ZipFile

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.config_io import value_of

MAX_BYTES = 1 << 30  # largest size of one file, also after decompression
MAX_PIXELS = 64_000_000  # of one image; 7680x4320 has half as many. `system/surroundings.py` tells OpenCV the same
MAX_TEXT_BYTES = 64 << 20  # largest size of a JSON, YAML or text file
MAX_ARRAYS = 1000  # in one .npz file
MAX_NODES = 100_000  # entries of a YAML text, each alias counted as often as it is used
MAX_NESTED = 50
ACCESS_HINT = "check the path and its permissions."
Kind = Literal["a file", "a folder", "nothing", "a device or a pipe"]
_BROKEN = (OSError, ValueError, TypeError, EOFError, BadZipFile, zlib.error, LZMAError)
_UNUSUAL = (RuntimeError, MemoryError, OverflowError)  # encrypted, unknown compression, nested header


def kind_of(path: Path) -> Kind:
    """What is at `path`, links followed; a broken link is nothing. InputError for a name or a parent of no use."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        if isinstance(error, FileNotFoundError | NotADirectoryError) or "symbolic links" in str(error):
            return "nothing"
        raise input_error(shortened(path), "a usable path", error.strerror or str(error), ACCESS_HINT) from None
    except ValueError as error:  # a zero byte in a name that comes from a file
        raise input_error(ascii(str(path)), "a usable path", str(error), ACCESS_HINT) from None
    if stat.S_ISREG(mode):
        return "a file"
    return "a folder" if stat.S_ISDIR(mode) else "a device or a pipe"


def shortened(path: Path, most: int = 120) -> str:
    """The path as text, without its middle if it is very long."""
    text = str(path)
    return text if len(text) <= most else f"{text[: most // 2]}...{text[-most // 2 :]}"


@contextmanager
def reading(path: Path, expected: str = "a readable file", fix: str = ACCESS_HINT) -> Iterator[None]:
    """Convert errors of the system to an InputError about `path`: those of a file that is open do not name it."""
    try:
        yield
    except OSError as error:
        raise input_error(path, expected, error.strerror or str(error), fix) from None


def demand_file(path: Path, expected: str, fix: str, most: int = MAX_BYTES) -> None:
    """Raise InputError unless `path` is a regular file of at most `most` bytes."""
    kind = kind_of(path)
    if kind != "a file":
        raise input_error(path, expected, "No such file" if kind == "nothing" else kind, fix)
    if (size := path.stat().st_size) > most:
        raise input_error(path, f"at most {most >> 20} MB", f"{size >> 20} MB", fix)


def read_bytes(path: Path, expected: str = "a readable file", fix: str = ACCESS_HINT) -> NDArray[np.uint8]:
    """(N,) bytes of a file."""
    demand_file(path, expected, fix)
    with reading(path, expected, fix):
        return np.fromfile(path, np.uint8)


def read_text(path: Path, expected: str, fix: str, *, or_latin_1: bool = False) -> str:
    """The text of a file in UTF-8, or in what its first bytes tell: editors on Windows write UTF-16 and a BOM.

    Args:
        or_latin_1: read other bytes as Latin-1, where only comments can have them.
    """
    demand_file(path, expected, fix, MAX_TEXT_BYTES)
    try:
        with path.open("rb") as file:
            encoding = _encoding(file.read(4))
        try:
            return path.read_text(encoding=encoding)
        except UnicodeDecodeError:
            if not or_latin_1 or encoding != "utf-8-sig":
                raise
            return path.read_text(encoding="latin-1")
    except (OSError, UnicodeError) as error:
        raise input_error(path, expected, str(error).split("\n")[0], fix) from None


def _encoding(start: bytes) -> str:
    # The first character of our files is always ASCII, so that a zero byte beside it tells UTF-16.
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if len(start) > 1 and (start[0] == 0) != (start[1] == 0):
        return "utf-16-le" if start[0] else "utf-16-be"
    return "utf-8-sig"


def read_numpy(path: Path, expected: str, fix: str) -> NDArray | dict[str, NDArray]:
    """The array of an .npy file, or the named arrays of an .npz file; no pickles."""
    stored = read_bytes(path, expected, fix).tobytes()
    try:
        return _archive(stored) if stored.startswith(b"PK") else _array(stored)
    except (*_BROKEN, *_UNUSUAL) as error:
        problem = (str(error) or type(error).__name__).split("\n")[0][:120]
    raise input_error(path, expected, problem, fix)


def read_only_array(path: Path, fix: str) -> NDArray:
    """The array of an .npy file, or the only one of an .npz file."""
    stored = read_numpy(path, "a NumPy file", fix)
    arrays = [stored] if isinstance(stored, np.ndarray) else list(stored.values())
    if len(arrays) != 1:
        raise input_error(path, "one array", f"{len(arrays)}", fix)
    return arrays[0]


def _archive(stored: bytes) -> dict[str, NDArray]:
    with ZipFile(io.BytesIO(stored)) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        # Python's zipfile never decompresses a member to more than its header says.
        size = sum(member.file_size for member in members)
        if size > MAX_BYTES or len(members) > MAX_ARRAYS:
            raise ValueError(f"{len(members)} arrays of {size >> 20} MB; at most {MAX_BYTES >> 20} MB are read")
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(stored: bytes) -> NDArray:
    file = io.BytesIO(stored)
    if not stored.startswith(np.lib.format.MAGIC_PREFIX):
        raise ValueError("pickled objects or something else" if stored else "an empty file")
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in readers:
        raise ValueError(f"format version {version[0]}.{version[1]}")
    shape, _, dtype = readers[version](file)
    if dtype.hasobject:
        raise ValueError("pickled objects")
    if dtype.kind not in "biufcSU":
        raise ValueError(f"values of type {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(stored) - file.tell():
        raise ValueError(f"a header of shape {shape} for {len(stored) - file.tell()} bytes")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


class BoundedLoader(yaml.SafeLoader):
    """Safe YAML of bounded nesting and size, without one name twice."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One node; an error if it is nested too deeply, before the parser's own stack overflows."""
        self._depth += 1
        if self._depth > MAX_NESTED:
            raise yaml.YAMLError(f"entries nested more than {MAX_NESTED} deep")
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def get_single_node(self) -> Any:
        """The whole text; an error if it has too many entries."""
        node = super().get_single_node()
        if node is not None and (size := _unfolded(node, {}, 0)) > MAX_NODES:
            raise yaml.YAMLError(f"{size:.0e} entries, aliases counted as often as used; at most {MAX_NODES} are read")
        return node


def load_yaml(text: str, loader: type[BoundedLoader] = BoundedLoader) -> Any:
    """The data in a YAML text; yaml.YAMLError or ValueError if it is none, or beyond the limits."""
    try:
        return yaml.load(text, loader)  # a safe loader, see above
    except RecursionError:
        raise yaml.YAMLError("entries nested too deeply") from None


def _unfolded(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """Entries that a node stands for."""
    if id(node) in known:
        if not known[id(node)]:
            raise yaml.YAMLError("an entry that contains itself")
        return known[id(node)]
    if depth > MAX_NESTED:
        raise yaml.YAMLError(f"entries nested more than {MAX_NESTED} deep")
    known[id(node)] = 0  # not known yet
    parts = node.value if isinstance(node, yaml.CollectionNode) else []
    if isinstance(node, yaml.MappingNode):
        names = Counter(key.value for key, _ in parts if isinstance(key, yaml.ScalarNode) and key.value != "<<")
        if twice := [name for name, count in names.items() if count > 1]:
            raise yaml.YAMLError(f"the name {twice[0]!r} twice in one place")
        parts = [part for pair in parts for part in pair]
    known[id(node)] = 1 + sum(_unfolded(part, known, depth + 1) for part in parts)
    return known[id(node)]


def read_json(
    path: Path, fix: str = "correct it or remove it.", expected: str = "a JSON object", kind: type = dict
) -> Any:
    """The object in a JSON file; of another `kind`, its list."""
    try:
        stored = json.loads(read_text(path, expected, fix))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise input_error(path, expected, str(error).split("\n")[0], fix) from None
    if not isinstance(stored, kind):
        raise input_error(path, expected, type(stored).__name__, fix)
    return stored


def read_own(path: Path, hint: Any, fix: str) -> Any:
    """The contents of a JSON file that this program wrote, of a type as `core.config_io.value_of` takes it.

    Another version, another program or a disk may have changed it: it is checked as if a stranger had written it.
    """
    is_list = get_origin(hint) is tuple
    stored = read_json(path, fix, "a JSON list" if is_list else "a JSON object", list if is_list else dict)
    return of_type(path, hint, stored, "file", fix)


def read_parts(path: Path, parts: Mapping[str, Any], fix: str) -> dict[str, Any]:
    """As `read_own`, of an object that has these parts, each of its type, and others, which are not looked at."""
    stored = read_json(path, fix)
    for name, hint in parts.items():
        if name not in stored:
            raise input_error(path, f"an entry {name}", "none", fix)
        stored[name] = of_type(path, hint, stored[name], name, fix)
    return stored


def of_type(path: Path, hint: Any, value: Any, where: str, fix: str) -> Any:
    """The value that was found somewhere in a file, of that type; InputError about the file."""
    try:
        return value_of(hint, value, where)
    except InputError as error:
        problem = str(error).split(". Fix: ")[0]
        raise InputError(f"{path}: {problem}. Fix: {fix[:1].upper()}{fix[1:]}") from None


def read_matrix(path: Path, stored: dict[str, Any], key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The finite matrix `key` of an object read from `path`; dots in the key go into nested objects."""
    value: Any = stored
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    want, fix = f"{key}, {shape[0]}x{shape[1]} numbers", "process the dataset again."
    if value is None:
        raise input_error(path, want, "no such key", fix)
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise input_error(path, want, "NaN or infinity" if matrix.shape == shape else f"shape {matrix.shape}", fix)
    return matrix


def read_table(path: Path, fix: str) -> NDArray[np.float64]:
    """(N, K) numbers of a text file, separated by commas or blanks, one row per line; '#' starts a comment."""
    lines = read_text(path, "rows of numbers", fix).splitlines()
    try:
        rows = [re.split(r"[,\s]+", line.split("#")[0].strip(", \t")) for line in lines]
        numbers = [[float(entry) for entry in row] for row in rows if row != [""]]
    except ValueError as error:
        raise input_error(path, "rows of numbers", str(error).split("\n")[0], fix) from None
    if not numbers or len({len(row) for row in numbers}) != 1:
        raise input_error(path, "rows of equally many numbers", "other rows", fix)
    return np.array(numbers)
