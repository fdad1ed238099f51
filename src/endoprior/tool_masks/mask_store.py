"""Find the tools in all frames of a sequence folder. Their masks are kept, one small PNG per frame, with what has been
done, so that the search can be resumed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import InputError
from ..core.config_io import value_of
from ..core.ranges import evenly_spaced
from ..core.types import Frame
from ..data import FrameSequence
from ..data.found_tools import FoundTools, FrameRow
from ..data.images import read_tool_mask, save_png
from ..footage.border import find_outline, masked_border
from ..footage.image_operations import Mask, components, regions_where
from ..system.atomic import read_json_object, whole_file, write_json
from .network import ToolFinder, full_size

STATE = "state.json"
TYPES = {"rows": tuple[FrameRow, ...], "confidence": tuple[float, ...], "carried": tuple[str, ...]}
"""What it holds by name; any other name is a list of `PROMPTS`."""
PROMPTS = tuple[tuple[int, int, int], ...]


class MaskStore(Mapping[int, Mask]):
    """Masks by frame; `mask` gives an empty one where none was written."""

    def __init__(self, folder: Path, size: tuple[int, int]) -> None:
        """Args: folder: made if needed. size: (width, height), px."""
        self.folder, self._shape = folder, size[::-1]
        folder.mkdir(parents=True, exist_ok=True)

    def __getitem__(self, index: int) -> Mask:
        file = self._file(index)
        if not file.exists():
            raise KeyError(index)
        return read_tool_mask(file)

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(int(file.stem) for file in self.folder.glob("*.png")))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def mask(self, index: int) -> Mask:
        """(H, W) the mask of a frame; empty if none was written."""
        return self[index] if self._file(index).exists() else np.zeros(self._shape, bool)

    def put(self, index: int, mask: Mask) -> None:
        """Write the mask (H, W) of a frame."""
        with whole_file(self._file(index)) as temporary:
            save_png(temporary, np.where(mask, 255, 0).astype(np.uint8))

    def add(self, index: int, mask: Mask) -> None:
        """Add the pixels of a mask (H, W) to that of a frame. To add them twice changes nothing."""
        if mask.any():
            self.put(index, self.mask(index) | mask)

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.png"


def read_state(folder: Path) -> dict[str, Any]:
    """What an interrupted run has done; empty before the first, and where the file is damaged: all is done again."""
    stored = read_json_object(folder / STATE) or {}
    try:
        return {name: value_of(TYPES.get(name, PROMPTS), value, name) for name, value in stored.items()}
    except InputError:
        return {}


def write_state(folder: Path, state: dict[str, Any]) -> None:
    """Note what has been done."""
    write_json(folder / STATE, state)


SAMPLES = 16  # Number of frames from which the border of the view is taken
Progress = Callable[[str, int, int], None]


def no_progress(_what: str, _done: int, _total: int) -> None:
    """Report nothing."""


def find_in_sequence(
    sequence: FrameSequence, *, refine: bool = False, progress: Progress = no_progress
) -> Iterator[tuple[Mask, FoundTools]]:
    """Find the tools of every frame, in order: (H, W) True on everything that is not tissue, as a mask file stores it,
    and the tools of the frame. `refine` only adds pixels to the sequence's masks, in regions that touch them.
    """
    total, finder = len(sequence), ToolFinder()
    view = view_of([sequence.frame(i) for i in evenly_spaced(total, SAMPLES)])
    images = (sequence.frame(i).rgb_u8 for i in range(total))
    for i, small in enumerate(finder.find_over_time(images, view)):
        frame, found = sequence.frame(i), replace(small, tool_mask=full_size(small.tool_mask, view.shape) & view)
        if refine:
            given = ~frame.tissue_mask & view
            labels, boxes = components(given | found.tool_mask)
            touches = np.isin(np.arange(len(boxes)), labels[given])
            found = FoundTools(regions_where(touches, labels), found.confidence)
        progress("finding tools", i + 1, total)
        yield found.tool_mask | ~view, found


def view_of(frames: Sequence[Frame]) -> Mask:
    """(H, W) True inside the endoscope's image: not beyond its border, and not masked and black in all frames."""
    images = [frame.rgb_u8 for frame in frames]
    outline = find_outline(images)
    masked = masked_border(outline, images, (frame.tissue_mask for frame in frames))
    return ~(outline.in_strip | outline.outside | masked)
