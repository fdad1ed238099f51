"""Masks that the programs of SAM 2 write: numbers of objects in palette PNGs, a folder per object, or SA-V's JSON.

`vos_inference.py` writes OUT/VIDEO/00000.png with the object numbers as values of a palette image, or, for objects that
overlap, OUT/VIDEO/OBJECT/00000.png. The annotations of SA-V are one JSON: a run-length code per frame and object.
All objects are tools, unless some are asked for: they have numbers in place of names.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...core.checks import input_error
from ..files import entries, files_with, in_order
from ..images import Size, decode_image
from ..mask_files import MASK_SUFFIXES, OPTION, Mask, demand_size
from ..reading import read_bytes, read_text
from .parts import MaskFolder, MaskFrame, mask_of_coco, tool_labels, union, union_of_files

PALETTE_IMAGE = 3  # color type in the header of a PNG
MAX_FRAMES = 10_000_000  # of a video
HINT = "Write it with the program of SA-V, or pass masks as PNG."


def palette_folder(folder: Path, asked: str) -> MaskFolder | None:
    """Palette PNGs that are named by numbers, as `vos_inference.py` writes them; None for other files."""
    files = files_with(folder, MASK_SUFFIXES)
    if not files or not all(file.suffix.lower() == ".png" and file.stem.isdigit() for file in files):
        return None
    palette = _palette(files[0])
    if len(palette) < 2 or not np.ptp(palette[:, :3], axis=1).any():  # grays are levels, not numbers of objects
        return None
    wanted = [int(name) for name in asked.split(",") if name.strip().isdigit()]
    if asked and not wanted:
        raise input_error(OPTION, f"numbers of objects in {folder}", asked, f"`{OPTION} 1`.")

    def reader(file: Path):
        return lambda size: _objects(file, size, wanted)

    which = f"objects {', '.join(map(str, wanted))}" if wanted else "all objects"
    note = f"SAM 2, palette images with object numbers; tools: {which}"
    return MaskFolder([MaskFrame(file.name, reader(file)) for file in files], note, True)


def object_folders(folder: Path, asked: str) -> MaskFolder | None:
    """A folder per object, named by its number, each with a mask per frame; None for other folders."""
    parts = in_order(each for each in entries(folder) if each.is_dir() and each.name.isdigit())
    if not parts or files_with(folder, MASK_SUFFIXES):
        return None
    objects = [part.name for part in parts]
    tools = tool_labels(folder, objects, asked) if asked else objects
    by_name: dict[str, list[Path]] = {}
    for part in parts:
        for file in files_with(part, MASK_SUFFIXES):
            by_name.setdefault(file.name, []).extend([file] if part.name in tools else [])
    if not by_name:
        return None
    names = [file.name for file in in_order(map(Path, by_name))]
    note = f"SAM 2, a folder per object; tools: objects {', '.join(tools)}"
    return MaskFolder([MaskFrame(name, union_of_files(by_name[name])) for name in names], note, True)


def sav_file(file: Path, asked: str) -> MaskFolder | None:
    """Annotations of SA-V, `VIDEO_manual.json` or `VIDEO_auto.json`; None for another JSON."""
    try:
        stored = json.loads(read_text(file, "a JSON file", HINT))
    except (ValueError, RecursionError):
        return None
    if not isinstance(stored, dict) or not isinstance(masklets := stored.get("masklet"), list):
        return None
    if not masklets or not all(isinstance(frame, list) for frame in masklets):
        raise input_error(file, "masklet to hold a list of objects per frame", "something else", HINT)
    count = max(len(frame) for frame in masklets)
    given = stored.get("masklet_id")
    ids = [str(each) for each in (given if isinstance(given, list) and len(given) == count else range(count))]
    tools = tool_labels(file, ids, asked) if asked else ids
    wanted = [i for i, name in enumerate(ids) if name in tools]
    # Every fourth frame of the video is annotated: the number of a mask is that of its frame in the video.
    total = stored.get("video_frame_count")
    known = total if isinstance(total, int | float) and 0 < total < MAX_FRAMES else 0
    step = max(1, round(known / len(masklets)))

    def reader(frame: list[Any]):
        return lambda size: union((_sav_mask(file, frame[i], size) for i in wanted if i < len(frame)), size)

    frames = [MaskFrame(f"{i * step}.json", reader(frame)) for i, frame in enumerate(masklets)]
    every = f"; one frame in {step} has masks" if step > 1 else ""
    return MaskFolder(frames, f"SA-V annotations; tools: objects {', '.join(tools)}{every}", True)


def _sav_mask(file: Path, code: Any, size: Size) -> Mask:
    """(H, W) from {"size": [height, width], "counts": ...}; empty where the object is out of view."""
    if not code:
        return np.zeros(size[::-1], bool)
    try:
        mask = mask_of_coco(code["counts"], code["size"])
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise input_error(file, "run lengths that fill a mask", str(error) or type(error).__name__, HINT) from None
    demand_size(file, (mask.shape[1], mask.shape[0]), size)
    return mask


def _objects(file: Path, size: Size, wanted: list[int]) -> Mask:
    """(H, W) True on the wanted objects of a palette image, or on all but object 0."""
    palette, pixels = _palette(file), decode_image(file, None)
    demand_size(file, (pixels.shape[1], pixels.shape[0]), size)
    if pixels.ndim == 2 or not len(palette):  # a frame that was saved as gray: the values themselves
        values = pixels if pixels.ndim == 2 else pixels[..., 1]
        return np.isin(values, wanted) if wanted else values > 0
    color = pixels[..., 2::-1]
    if not wanted:
        return (color != palette[0]).any(-1)
    return union(((color == palette[i]).all(-1) for i in wanted if i < len(palette)), size)


def _palette(file: Path) -> np.ndarray:
    """(N, 3) red, green, blue of a palette PNG; (0, 3) for another image."""
    data = read_bytes(file).tobytes()
    at = data.find(b"PLTE", 33)
    if at < 0 or data[12:16] != b"IHDR" or data[25] != PALETTE_IMAGE:
        return np.zeros((0, 3), np.uint8)
    length = int.from_bytes(data[at - 4 : at], "big") // 3 * 3
    return np.frombuffer(data[at + 4 : at + 4 + length], np.uint8).reshape(-1, 3)
