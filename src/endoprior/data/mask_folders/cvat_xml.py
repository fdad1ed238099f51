"""Masks and polygons of *CVAT for images 1.1*: one `annotations.xml`.

<image name width height> holds <mask label rle left top width height> and <polygon label points>. `rle` counts pixels
of the box row by row: outside, inside, outside, ... of the object. Points are `x,y;x,y`, px from the image's corner.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np

from ...core.checks import input_error
from ..reading import read_text
from .frames import Mask, MaskFolder, MaskFrame, Size, demand_size, sorted_frames
from .labels import tool_labels, words_about
from .run_lengths import mask_of_runs

SHAPES = ("mask", "polygon")
HINT = "Export the task from CVAT as `CVAT for images 1.1`."
MOST_PX = 1 << 16
"""Largest coordinate of a point."""
Shape = tuple[str, Mapping[str, str]]
"""Tag and attributes."""


def annotations(file: Path, asked: str) -> MaskFolder | None:
    """The masks in an XML file of CVAT; None for another XML file.

    Raises:
        InputError: damaged, of a video task, without images, or labels that do not tell which are tools.
    """
    text = read_text(file, "an XML file", HINT)
    if "<annotations" not in text:
        return None
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # CVAT writes neither; entities can expand without end
        raise input_error(file, "CVAT's XML", "a document type", HINT)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise input_error(file, "CVAT's XML", str(error), HINT) from None
    images = root.findall("image")
    if not images:
        got = "tracks of a video" if root.find("track") is not None else "no images"
        raise input_error(file, "images with masks or polygons", got, HINT)
    used = [shape.get("label", "") for image in images for shape in image if shape.tag in SHAPES]
    named = [each.text or "" for each in root.iterfind(".//labels/label/name")]
    labels = [*dict.fromkeys([*named, *used])]
    tools = tool_labels(file, labels, asked)
    skipped = Counter(shape.tag for image in images for shape in image if shape.get("label") in tools)
    frames = sorted_frames([_frame(file, image, tools) for image in images])
    left_out = ", ".join(f"{count} of {tag}" for tag, count in sorted(skipped.items()) if tag not in SHAPES)
    note = f"CVAT for images; {words_about(labels, tools)}" + (f"; shapes left out: {left_out}" if left_out else "")
    return MaskFolder(frames, note, True)


def _frame(file: Path, image: ElementTree.Element, tools: list[str]) -> MaskFrame:
    name = Path(image.get("name", "")).name
    shapes = [(shape.tag, shape.attrib) for shape in image if shape.tag in SHAPES and shape.get("label") in tools]

    def read(size: Size) -> Mask:
        mask = np.zeros(size[::-1], bool)
        with _damage_named(f"{file}: {name}"):
            own_size = int(image.get("width", 0)), int(image.get("height", 0))
        demand_size(f"{file}: {name}", own_size, size)
        with _damage_named(f"{file}: {name}"):
            for shape in shapes:
                _paint(mask, shape)
        return mask

    return MaskFrame(name, read)


@contextmanager
def _damage_named(subject: str) -> Iterator[None]:
    """Turn errors of damaged numbers into one that names the image."""
    try:
        yield
    except KeyError as error:
        raise input_error(subject, f"the attribute {error}", "none", HINT) from None
    except (OverflowError, ValueError) as error:
        raise input_error(subject, "masks and polygons", str(error)[:80], HINT) from None


def _paint(mask: Mask, shape: Shape) -> None:
    """Add a shape to a mask (H, W). ValueError or KeyError if it is not one."""
    tag, given = shape
    if tag == "polygon":
        pairs = [point.split(",") for point in given["points"].split(";")]
        if any(len(pair) != 2 for pair in pairs):
            raise ValueError("points that are not x,y;x,y")
        points = np.array(pairs, float)
        if not (np.abs(points) < MOST_PX).all():
            raise ValueError("points far outside of the image")
        painted = mask.astype(np.uint8)
        # OpenCV counts centers of pixels from 0.
        cv2.fillPoly(painted, [np.round(points - 0.5).astype(np.int32)], 1)
        mask |= painted > 0
        return
    left, top, width, height = (int(float(given[side])) for side in ("left", "top", "width", "height"))
    if min(left, top) < 0 or min(width, height) < 1 or left + width > mask.shape[1] or top + height > mask.shape[0]:
        raise ValueError("a box outside of the image")
    runs = [int(part) for part in given["rle"].split(",")]
    mask[top : top + height, left : left + width] |= mask_of_runs(runs, width * height).reshape(height, width)
