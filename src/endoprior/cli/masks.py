"""`endoprior masks DATA`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..core.checks import frame_list, input_error
from ..core.ranges import evenly_spaced
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

    tissue: tuple[str, ...] = field(default=(), metadata={"metavar": "FRAME,X,Y ..."})
    """Points on tissue that the masks of DATA take for a tool: the masked region there is freed in all frames; pixels
    are only removed."""

    examples = ("DATA", "DATA --refine", "DATA --with sam2", "DATA --tool 12,310,205", "DATA --tissue 12,80,40")

    def execute(self) -> None:
        """Find tools and write their masks."""
        clicked = [name for name, points in (("--tool", self.tool), ("--tissue", self.tissue)) if points]
        other = [name for name, on in (("--refine", self.refine), ("--with", self.segmenter is not None)) if on]
        if clicked and (other := [*other, *clicked[1:]]):
            fix = f"call it with {other[0]} first, then without."
            raise input_error(clicked[0], f"no {other[0]}", other[0], fix)
        from ..data import load_sequence
        from ..data.edit import writable_masks

        sequence = load_sequence(self.data)
        writable_masks(sequence)
        if clicked:
            self._correct(sequence)
        else:
            self._find_all(sequence)
        say(f"look at {self.data / SHEET}; to correct masks: `{command('view', self.data)}`")

    def _find_all(self, sequence: FrameSequence) -> None:
        """Find the tools of every frame, by our own means or by a segmenter that they prompt."""
        from ..data.edit import note_found_masks
        from ..data.found_tools import FrameRow, uncertain_frames, write_rows
        from ..prepare.networks import open_sam2
        from ..tool_masks.tool_finder import find_in_sequence
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
                put(i, mask, tools.tool_mask, f"{rows[i].share:.1%}")
        write_rows(self.data, rows)
        count = sum(row.share > 0 for row in rows)
        note_found_masks(self.data, count / len(rows), segmenter.name if segmenter else "")
        say(f"tools in {count} of {len(rows)} frames, at most {max(row.share for row in rows):.1%} of a frame")
        if uncertain := uncertain_frames(rows):
            say(f"uncertain: {frame_list(uncertain)}")

    def _correct(self, sequence: FrameSequence) -> None:
        """Add the tools at the points of `--tool` to the masks of all frames, or free the tissue at `--tissue`."""
        from ..data.found_tools import read_rows, write_rows
        from ..tool_masks.clicked_tools import find_clicked, free_clicked, parse_click
        from ..tool_masks.mask_store import MaskStore

        adds = bool(self.tool)
        option, points = ("--tool", self.tool) if adds else ("--tissue", self.tissue)
        clicks = [parse_click(text, option) for text in points]
        changed, camera = dict[int, float](), sequence.camera(0)
        with _replacing(sequence, {click.frame for click in clicks}) as (put, work, progress):
            regions = MaskStore(work, (camera.width, camera.height))
            search = find_clicked if adds else free_clicked
            for step in search(sequence, clicks, lambda i: ~sequence.frame(i).tissue_mask):
                progress("finding the tool" if adds else "following the tissue", step.done, step.total)
                if step.frame is not None and step.region is not None:
                    regions.add(step.frame, step.region)
            for i in range(len(sequence)):
                tool, region = ~sequence.frame(i).tissue_mask, regions.mask(i)
                share = float(region.mean()) * (1 if adds else -1)
                mask = tool | region if adds else tool & ~region
                changed |= {i: share} if share else {}
                put(i, mask, mask, f"{share:+.1%}", is_new=bool(share) or not sequence.mask_files)
        if rows := read_rows(self.data):
            write_rows(self.data, [row.with_added(changed.get(row.frame, 0.0)) for row in rows])
        most = max(map(abs, changed.values()), default=0)
        say(
            f"{'added' if adds else 'freed'} in {len(changed)} of {len(sequence)} frames, at most {most:.1%} of a frame"
        )
        if changed:
            say(f"changed: {frame_list(changed)}")


@contextmanager
def _replacing(
    sequence: FrameSequence, also_shown: Set[int] = frozenset()
) -> Iterator[tuple[Callable[..., None], Path, Counting]]:
    """Yield what takes the mask of a frame, a folder to work in, and the progress; then write masks and sheet."""
    from ..data.edit import replace_masks
    from ..tool_masks.mask_store import MaskStore
    from ..visualization.image_tools import mask_sheet, write_png

    shown, pictures, camera = {*evenly_spaced(len(sequence), SHOWN), *also_shown}, [], sequence.camera(0)

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
