"""Calibration files as flat tables of names and values, whatever program wrote them.

The content tells the format, not the name of the file: OpenCV's YAML, JSON and XML, plain YAML and JSON, ini sections,
COLMAP's `cameras.txt` or `.bin`, rows of numbers (`intrinsics.txt`), NumPy. Nothing in a file is ever executed.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from ..core.checks import InputError, input_error
from ..data.colmap import read_cameras
from ..data.lens import MODELS, UNSUPPORTED
from ..data.reading import BoundedLoader, load_yaml, read_bytes, read_numpy, read_text

Table = dict[str, Any]  # numbers, arrays and texts, by name in lower case without punctuation
FORMATS = "a calibration of OpenCV, ROS, Kalibr, ORB-SLAM, COLMAP or the da Vinci, or rows of numbers"
HINT = "Use the names K_left, distortion_left, K_right, distortion_right, R, T_mm, width, height (docs/prepare.md)."
FOREIGN = {
    b"MATLAB": ("a .mat file of MATLAB", "Write K and the distortion to a .json file."),
    b"\x89HDF": ("a .mat or .h5 file (HDF5)", "Write K and the distortion to a .json file."),
    b"\x80": ("a pickle, which could run programs", "Save it with numpy.savez, or as .json."),
    b"\xd0\xcf\x11\xe0": ("a document of an office program", "Export it as text."),
}  # first bytes of formats that are not read: what they are, and what to do
COLMAP_LINE = re.compile(r"\d+\s+[A-Z_]{3,}\s+\d+\s+\d+(?:\s+\S+)+")
INI_SECTION = re.compile(r"^\s*\[[A-Za-z][^\]=:]*\]\s*$", re.MULTILINE)
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
ONLY_NUMBERS = re.compile(rf"[\s,;\[\]()]*(?:{NUMBER.pattern}[\s,;\[\]()]+)*")


def read_table(path: Path) -> Table:
    """The names and values of a calibration file; nested names are joined, matrices become arrays.

    Raises:
        InputError: unreadable, a format that is not read (it is named), or no named values.
    """
    try:
        content = _content(path)
        if isinstance(content, dict) and content:
            return {plain(name): value for name, value in _flat(content).items()}
    except InputError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, yaml.YAMLError, configparser.Error) as error:
        raise input_error(path, "a readable calibration", " ".join(str(error).split())[:120], "Correct it.") from None
    got = "a list" if isinstance(content, list) else "text without named values" if content else "no named values"
    raise input_error(path, FORMATS, got, HINT)


def plain(name: str) -> str:
    """A name in lower case without punctuation."""
    return "".join(c for c in name.lower() if c.isalnum())


def _content(path: Path) -> Any:
    """What the file holds, in the nesting of its format."""
    if path.suffix.lower() in (".npz", ".npy"):
        stored = read_numpy(path, "a readable calibration", "Save it again with numpy.savez.")
        return _of_rows(path, np.atleast_2d(stored)) if isinstance(stored, np.ndarray) else stored
    start = read_bytes(path, "a calibration file", "Check the path.")[:16].tobytes()
    for mark, (what, fix) in FOREIGN.items():
        if start.startswith(mark):
            raise input_error(path, FORMATS, what, fix)
    if path.name == "cameras.bin":
        return _of_colmap(path)
    return _of_text(path, read_text(path, "a calibration file", "Check the path.", or_latin_1=True))


def _of_text(path: Path, text: str) -> Any:
    if text.lstrip().startswith("<"):
        return _of_xml(path, text)
    if path.suffix.lower() == ".json":
        return json.loads(text)
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and all(COLMAP_LINE.fullmatch(line.strip()) for line in lines):
        return _of_colmap(path)
    if lines and ONLY_NUMBERS.fullmatch("\n".join(lines) + "\n"):
        numbers = [[float(word) for word in words] for words in map(NUMBER.findall, lines) if words]
        if len({len(row) for row in numbers}) == 1:
            return _of_rows(path, np.array(numbers))
    if found := INI_SECTION.search(text):
        return _of_ini(text[found.start() :])
    # OpenCV writes "%YAML:1.0", which is not YAML.
    return load_yaml("\n".join(line for line in text.splitlines() if not line.startswith("%YAML")), _Loader)


class _Loader(BoundedLoader):
    """Safe YAML that also knows OpenCV's matrices."""


def _mapping(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, True)


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _mapping)


def _of_xml(path: Path, text: str) -> Any:
    fix = "Write it with cv2.FileStorage, or as .json."
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # OpenCV writes neither; entities can expand without end
        raise input_error(path, "OpenCV's XML", "a document type", fix)
    try:
        # The text is decoded already: another encoding in its first line must not count.
        root = ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))
    except ElementTree.ParseError as error:
        raise input_error(path, "OpenCV's XML", str(error), fix) from None
    if root.tag != "opencv_storage":
        raise input_error(path, "OpenCV's XML, <opencv_storage>", f"<{root.tag[:40]}>", fix)
    return {each.tag: _xml_value(each) for each in root}


def _xml_value(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _xml_value(child) for child in node}
    words = (node.text or "").replace('"', " ").split()
    numbers = _numbers(words)
    if numbers is None:
        return " ".join(words)
    return numbers[0] if len(numbers) == 1 and node.tag != "data" else numbers


def _numbers(words: list[str]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _of_colmap(path: Path) -> Table:
    cameras = list(read_cameras(path).values())
    if len(cameras) != 1:
        fix = "Keep this video's camera alone, in cameras.txt."
        raise input_error(path, "one camera of COLMAP, which writes no R and T", f"{len(cameras)} cameras", fix)
    (camera,) = cameras
    if camera.model not in MODELS or camera.model in UNSUPPORTED:
        known = ", ".join(name for name in MODELS if name not in UNSUPPORTED)
        fix = "Choose OPENCV or OPENCV_FISHEYE in COLMAP."
        raise input_error(path, f"a camera model of {known}", camera.model, fix)
    names = MODELS[camera.model].split()
    if len(names) != len(camera.values):
        raise input_error(path, f"{len(names)} numbers of {camera.model}", str(len(camera.values)), "Write it again.")
    found = dict(zip(names, camera.values, strict=True))
    found |= {"fx": found["f"], "fy": found["f"]} if "f" in found else {}
    facts = {"camera_model": camera.model, "pixel_center": 0.5, "width": camera.width, "height": camera.height}
    return facts | found


def _of_rows(path: Path, rows: np.ndarray) -> Table:
    """3x3, 3x4 or 4x4 camera matrix; or `fx fy cx cy`, then distortion coefficients, if any."""
    rows = rows.astype(np.float64)
    if rows.shape == (1, 9) and not rows[0, [1, 3, 6, 7]].any() and rows[0, 8] == 1:
        rows = rows.reshape(3, 3)
    if rows.shape in ((3, 3), (3, 4), (4, 4)):
        if rows.shape[1] == 4 and rows[:3, 3].any():
            fix = "Write the 3x3 camera matrix K."
            raise input_error(path, "a camera matrix without a translation", "a projection matrix", fix)
        return {"K": rows[:3, :3]}
    numbers = rows.ravel()
    if 1 in rows.shape and len(numbers) in (4, 8, 9):
        return {"K": numbers[:4]} | ({"D": numbers[4:]} if len(numbers) > 4 else {})
    want = "a 3x3 camera matrix, or fx fy cx cy and distortion coefficients"
    raise input_error(path, want, f"{'x'.join(map(str, rows.shape))} numbers", HINT)


def _of_ini(text: str) -> Table:
    """Sections named after a side get its name in front; `R_0 R_1 ...` become arrays."""
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=("#", ";"), strict=True)
    parser.read_string(text)
    table: Table = {}
    for section in parser.sections():
        side = "left" if "left" in section.lower() else "right" if "right" in section.lower() else section
        values = {name: _ini_value(value) for name, value in parser.items(section)}
        for name in ("kc", "r", "t", "om"):
            parts = [values[f"{name}_{i}"] for i in range(14) if f"{name}_{i}" in values]
            if parts and f"{name}_0" in values:
                values[name] = parts
        table[side] = table.get(side, {}) | values
    return table


def _ini_value(text: str) -> Any:
    numbers = _numbers(text.strip(" []\"'").replace(",", " ").split())
    if numbers is None:
        return text.strip(" \"'")
    return numbers[0] if len(numbers) == 1 else numbers


def _flat(content: Mapping[Any, Any], prefix: str = "") -> Table:
    table: Table = {}
    for name, value in content.items():
        keys = {str(key) for key in value} if isinstance(value, dict) else None
        if keys is None:
            table[f"{prefix}{name}"] = value
        elif {"rows", "cols", "data"} <= keys:
            table[f"{prefix}{name}"] = np.reshape(value["data"], (int(value["rows"]), int(value["cols"])))
        elif {"sizes", "data"} <= keys:
            table[f"{prefix}{name}"] = np.reshape(value["data"], [int(n) for n in np.ravel(value["sizes"])])
        else:
            table |= _flat(value, f"{prefix}{name}.")
    return table
