"""`endoprior masks DATA`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..core.checks import input_error, number_ranges
from ..core.ranges import spread
from ..core.shell import command
from ..system.console import say
from .arguments import Command
from .progress import Counting

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..data import FrameSequence

SHEET = "tool_masks.png"
SHOWN, COLUMNS = 24, 6
"""Number of frames on the sheet, and of its columns."""
WIDTH_PX = 320
"""Of a frame on the sheet."""


@dataclass
class Masks(Command):
    """Find the tools in a sequence folder and write their masks to DATA/masks (255 = tool).

    The masks that were there are kept in DATA/masks_before. DATA/tool_masks.png shows frames to look at, and
    DATA/tool_masks.json holds the share and the confidence of each frame.
    """

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    refine: bool = False
    """The masks of DATA are right but miss parts, such as jaws: learn from them, and only add pixels."""
    segmenter: str | None = field(default=None, metadata={"name": "with", "metavar": "SEGMENTER"})
    """`sam2`: SAM 2 follows the tools that are found first through the video. A folder of its weights, or the name of a
    model, may follow after a colon."""
    tool: tuple[str, ...] = field(default=(), metadata={"metavar": "FRAME,X,Y ..."})
    """Points on tools that the masks of DATA miss: the frame, from 0, and px of the image. Such tools are found in all
    frames; pixels are only added."""

    examples = ("DATA", "DATA --refine", "DATA --with sam2", "DATA --tool 12,310,205")

    def execute(self) -> None:
        """Find tools and write their masks."""
        if self.tool and (self.refine or self.segmenter is not None):
            other = "--refine" if self.refine else "--with"
            raise input_error("--tool", f"no {other}", other, f"find the tools with {other} first, without --tool.")
        from ..data import load_sequence
        from ..data.writer import writable_masks

        sequence = load_sequence(self.data)
        writable_masks(sequence)
        if self.tool:
            self._add_clicked(sequence)
        else:
            self._find_all(sequence)
        say(f"look at {self.data / SHEET}; to correct masks: `{command('view', self.data)}`")

    def _find_all(self, sequence: FrameSequence) -> None:
        """Find the tools of every frame, by our own means or by a segmenter that they prompt."""
        from ..data.found_tools import FrameRow, uncertain_frames, write_rows
        from ..data.writer import note_found_masks
        from ..prepare.networks import open_sam2
        from ..tool_masks.sequence import find_in_sequence
        from ..tool_masks.video_segmenter import segment_sequence

        rows, segmenter = list[FrameRow](), None
        with _replacing(sequence) as (put, work, progress):
            if self.segmenter is None:
                found = find_in_sequence(sequence, refine=self.refine, progress=progress)
            else:
                segmenter = open_sam2(self.segmenter, "--with")
                found = segment_sequence(sequence, segmenter, work, refine=self.refine, progress=progress)
            for i, (mask, tools) in enumerate(found):
                rows.append(FrameRow.of(i, tools))
                put(i, mask, tools.mask, f"{rows[i].share:.1%}")
        write_rows(self.data, rows)
        count = sum(row.share > 0 for row in rows)
        note_found_masks(self.data, count / len(rows), segmenter.name if segmenter else "")
        say(f"tools in {count} of {len(rows)} frames, at most {max(row.share for row in rows):.1%} of a frame")
        if uncertain := uncertain_frames(rows):
            say(f"uncertain: frames {number_ranges(uncertain)}")

    def _add_clicked(self, sequence: FrameSequence) -> None:
        """Add the tools at the points of `--tool` to the masks of all frames."""
        from ..data.found_tools import read_rows, write_rows
        from ..tool_masks.clicked_tools import find_clicked, parse_click

        clicks = [parse_click(text, "--tool") for text in self.tool]
        changed = dict[int, float]()
        with _replacing(sequence, {click.frame for click in clicks}) as (put, _, progress):
            for step in find_clicked(sequence, clicks, lambda i: ~sequence.frame(i).tissue_mask):
                progress("finding the tool", step.done, step.total)
                i, added = step.frame, step.added
                if i is None or added is None:
                    continue
                share, mask = float(added.mean()), ~sequence.frame(i).tissue_mask | added
                changed |= {i: share} if share else {}
                put(i, mask, mask, f"+{share:.1%}", is_new=share > 0 or not sequence.mask_files)
        if rows := read_rows(self.data):
            write_rows(self.data, [row.with_added(changed.get(row.frame, 0.0)) for row in rows])
        most = max(changed.values(), default=0)
        say(f"added in {len(changed)} of {len(sequence)} frames, at most {most:.1%} of a frame")
        if changed:
            say(f"changed: frames {number_ranges(changed)}")


@contextmanager
def _replacing(
    sequence: FrameSequence, also_shown: Set[int] = frozenset()
) -> Iterator[tuple[Callable[..., None], Path, Counting]]:
    """Yield what takes the mask of a frame, a folder to work in, and the progress; then write masks and sheet."""
    from ..data.writer import replace_masks
    from ..tool_masks.mask_store import MaskStore
    from ..visualization.image_tools import mask_sheet, write_png

    shown, pictures, camera = {*spread(len(sequence), SHOWN), *also_shown}, [], sequence.camera(0)

    def put(i: int, mask: NDArray[np.bool_], tools: NDArray[np.bool_], caption: str, is_new: bool = True) -> None:
        if is_new:
            masks.put(i, mask)
        if i in shown:
            pictures.append((sequence.frame(i).rgb_u8, tools, f"{i}: {caption}"))

    with TemporaryDirectory(prefix="endoprior-") as work, Counting() as progress:
        masks = MaskStore(Path(work) / "masks", (camera.width, camera.height))
        yield put, Path(work) / "carried", progress
        replace_masks(sequence, masks)
    write_png(sequence.path / SHEET, mask_sheet(pictures, COLUMNS, WIDTH_PX))
