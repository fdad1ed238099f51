"""Masks that CVAT exports: *Segmentation mask 1.1* (colors, and their labels in `labelmap.txt`), *CVAT for images 1.1*.

A line of `labelmap.txt` is `label:red,green,blue:parts:actions`. Names of frames are those of the images of the task.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.checks import input_error
from ..files import files_with, in_order
from ..images import decode_image
from ..reading import kind_of, read_text
from .frames import Mask, MaskFolder, MaskFrame, Size, demand_size
from .labels import tool_labels, words_about

CLASSES, LABELS, LISTED = "SegmentationClass", "labelmap.txt", Path("ImageSets", "Segmentation", "default.txt")
HINT = "Export the task from CVAT as `Segmentation mask 1.1` again."
Color = tuple[int, int, int]


def segmentation_masks(folder: Path, asked: str) -> MaskFolder | None:
    """The archive of *Segmentation mask 1.1*, or its folder `SegmentationClass`; None for other folders."""
    root = folder.parent if folder.name == CLASSES else folder
    if kind_of(root / CLASSES) != "a folder" or kind_of(root / LABELS) != "a file":
        return None
    colors = read_labelmap(root / LABELS)
    labels = list(colors)
    tools = tool_labels(root / LABELS, [name for name in labels if name != "background"], asked)
    files = {file.stem: file for file in files_with(root / CLASSES, (".png",))}
    listed = _listed(root / LISTED)
    # Images without a shape are listed, but some versions write no mask for them.
    names = [file.name for file in in_order(map(Path, {*files, *listed}))]
    wanted = [colors[name] for name in tools]
    frames = [MaskFrame(f"{name}.png", _reader(files.get(name), colors, wanted)) for name in names]
    rest = [name for name in labels if name != "background"]
    return MaskFolder(frames, f"CVAT segmentation masks; {words_about(rest, tools)}", True)


def read_labelmap(file: Path) -> dict[str, Color]:
    """Label -> color (red, green, blue), in the order of the file.

    Raises:
        InputError: a line of another form, or no label.
    """
    found: dict[str, Color] = {}
    for line in read_text(file, "CVAT's labels", HINT).splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        try:
            name, color, *_ = line.rsplit(":", 3) if line.count(":") >= 3 else line.split(":")
            red, green, blue = (int(part) for part in color.split(","))
            if not all(0 <= value <= 255 for value in (red, green, blue)):
                raise ValueError
        except ValueError:
            raise input_error(file, "label:red,green,blue:parts:actions", line[:60], HINT) from None
        found[name.strip()] = red, green, blue
    if not found:
        raise input_error(file, "at least one label", "none", HINT)
    return found


def _listed(file: Path) -> list[str]:
    """Names of the images of the task; none if there is no list."""
    if kind_of(file) != "a file":
        return []
    return [Path(line.strip()).name for line in read_text(file, "a list of images", HINT).splitlines() if line.strip()]


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
            raise input_error(file, f"only colors of {LABELS}", got, HINT)
        return np.isin(packed, _packed(np.array(wanted)))

    return read


def _packed(colors: NDArray) -> NDArray[np.int64]:
    """One number per color (..., 3)."""
    return colors.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
