"""Masks that CVAT exports: *Segmentation mask 1.1* and *CVAT for images 1.1*.

The first has colors, and their labels in `labelmap.txt`: lines of `label:red,green,blue:parts:actions`. The second is
one XML: <image name width height> holds <mask label rle left top width height> and <polygon label points>. `rle` counts
pixels of the box row by row: outside, inside, outside, ... of the object. Points are `x,y;x,y`, px from the image's
corner. Names of frames are those of the images of the task.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.checks import input_error
from ..files import files_with, in_order, portable
from ..images import Size, decode_image
from ..mask_files import Mask, demand_size
from ..reading import kind_of, read_text
from .parts import MaskFolder, MaskFrame, mask_of_runs, sorted_frames, tool_labels, words_about

CLASSES, LABELS, LISTED = "SegmentationClass", "labelmap.txt", Path("ImageSets", "Segmentation", "default.txt")
PNG_HINT = "Export the task from CVAT as `Segmentation mask 1.1` again."
XML_HINT = "Export the task from CVAT as `CVAT for images 1.1`."
SHAPES = ("mask", "polygon")
MAX_COORDINATE_PX = 1 << 16  # largest coordinate of a point
Color = tuple[int, int, int]


def segmentation_masks(folder: Path, asked: str) -> MaskFolder | None:
    """The archive of *Segmentation mask 1.1*, or its folder `SegmentationClass`; None for other folders."""
    root = folder.parent if folder.name == CLASSES else folder
    if kind_of(root / CLASSES) != "a folder" or kind_of(root / LABELS) != "a file":
        return None
    colors = _labelmap(root / LABELS)
    labels = [name for name in colors if name != "background"]
    tools = tool_labels(root / LABELS, labels, asked)
    files = {file.stem: file for file in files_with(root / CLASSES, (".png",))}
    listed = ""
    if kind_of(root / LISTED) == "a file":  # images without a shape, for which some versions write no mask
        listed = read_text(root / LISTED, "a list of images", PNG_HINT)
    every = {*files, *(Path(portable(line.strip())).name for line in listed.splitlines() if line.strip())}
    wanted = [colors[name] for name in tools]
    frames = [
        MaskFrame(f"{file.name}.png", _reader(files.get(file.name), colors, wanted))
        for file in in_order(map(Path, every))
    ]
    return MaskFolder(frames, f"CVAT segmentation masks; {words_about(labels, tools)}", True)


def _labelmap(file: Path) -> dict[str, Color]:
    """Label -> color (red, green, blue), in the order of the file."""
    found: dict[str, Color] = {}
    for line in read_text(file, "CVAT's labels", PNG_HINT).splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        try:
            name, color, *_ = line.rsplit(":", 3) if line.count(":") >= 3 else line.split(":")
            red, green, blue = (int(part) for part in color.split(","))
            if not all(0 <= value <= 255 for value in (red, green, blue)):
                raise ValueError
        except ValueError:
            raise input_error(file, "label:red,green,blue:parts:actions", line[:60], PNG_HINT) from None
        found[name.strip()] = red, green, blue
    if not found:
        raise input_error(file, "at least one label", "none", PNG_HINT)
    return found


def _reader(file: Path | None, colors: dict[str, Color], wanted: list[Color]) -> Callable[[Size], Mask]:
    def read(size: Size) -> Mask:
        if file is None:
            return np.zeros(size[::-1], bool)
        pixels = decode_image(file, None)
        demand_size(file, (pixels.shape[1], pixels.shape[0]), size)
        if pixels.ndim == 2 and pixels.max(initial=0) < len(colors):  # indices of labels, in the order of the file
            return np.isin(pixels, [i for i, color in enumerate(colors.values()) if color in wanted])
        packed = _packed(pixels[..., 2::-1] if pixels.ndim == 3 else np.dstack([pixels] * 3))
        known = _packed(np.array([*colors.values(), (0, 0, 0)]))  # black: the background, if it is not listed
        if other := sorted({*np.unique(packed).tolist()} - {*known.tolist()}):
            got = f"{other[0] >> 16},{other[0] >> 8 & 255},{other[0] & 255}"
            raise input_error(file, f"only colors of {LABELS}", got, PNG_HINT)
        return np.isin(packed, _packed(np.array(wanted)))

    return read


def _packed(colors: NDArray) -> NDArray[np.int64]:
    """One number per color (..., 3)."""
    return colors.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])


def xml_annotations(file: Path, asked: str) -> MaskFolder | None:
    """The masks in an XML file of CVAT; None for another XML file."""
    text = read_text(file, "an XML file", XML_HINT)
    if "<annotations" not in text:
        return None
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # CVAT writes neither; entities can expand without end
        raise input_error(file, "CVAT's XML", "a document type", XML_HINT)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise input_error(file, "CVAT's XML", str(error), XML_HINT) from None
    images = root.findall("image")
    if not images:
        got = "tracks of a video" if root.find("track") is not None else "no images"
        raise input_error(file, "images with masks or polygons", got, XML_HINT)
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
    name = Path(portable(image.get("name", ""))).name
    subject = f"{file}: {name}"
    shapes = [shape for shape in image if shape.tag in SHAPES and shape.get("label") in tools]

    def read(size: Size) -> Mask:
        mask = np.zeros(size[::-1], bool)
        try:
            own_size = int(image.get("width", 0)), int(image.get("height", 0))
            if own_size == size:
                for shape in shapes:
                    (_paint_polygon if shape.tag == "polygon" else _paint_runs)(mask, shape.attrib)
        except KeyError as error:
            raise input_error(subject, f"the attribute {error}", "none", XML_HINT) from None
        except (OverflowError, ValueError) as error:
            raise input_error(subject, "masks and polygons", str(error)[:80], XML_HINT) from None
        demand_size(subject, own_size, size)
        return mask

    return MaskFrame(name, read)


def _paint_polygon(mask: Mask, given: dict[str, str]) -> None:
    """Add a shape with these attributes to a mask (H, W). ValueError or KeyError if it is not one."""
    pairs = [point.split(",") for point in given["points"].split(";")]
    if any(len(pair) != 2 for pair in pairs):
        raise ValueError("points that are not x,y;x,y")
    points = np.array(pairs, float)
    if not (np.abs(points) < MAX_COORDINATE_PX).all():
        raise ValueError("points far outside of the image")
    painted = mask.astype(np.uint8)
    # OpenCV counts centers of pixels from 0.
    cv2.fillPoly(painted, [np.round(points - 0.5).astype(np.int32)], 1)
    mask |= painted > 0


def _paint_runs(mask: Mask, given: dict[str, str]) -> None:
    """As `_paint_polygon`, from run lengths in a box."""
    left, top, width, height = (int(float(given[side])) for side in ("left", "top", "width", "height"))
    if min(left, top) < 0 or min(width, height) < 1 or left + width > mask.shape[1] or top + height > mask.shape[0]:
        raise ValueError("a box outside of the image")
    runs = [int(part) for part in given["rle"].split(",")]
    mask[top : top + height, left : left + width] |= mask_of_runs(runs, width * height).reshape(height, width)
