"""`endoprior masks DATA`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..core.checks import input_error, number_ranges
from ..core.ranges import spread
from ..core.shell import command
from ..system.console import say
from .arguments import Help, parse
from .progress import Counting

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..data import FrameSequence
    from ..data.found_tools import FoundTools
    from ..tool_masks.carry import VideoSegmenter
    from ..tool_masks.sequence import Progress

SHEET = "tool_masks.png"
SHOWN, COLUMNS = 24, 6
"""Number of frames on the sheet, and of its columns."""
WIDTH_PX = 320
"""Of a frame on the sheet."""


@dataclass
class Masks:
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


HELP = Help(examples=(("DATA",), ("DATA", "--refine"), ("DATA", "--with", "sam2"), ("DATA", "--tool", "12,310,205")))


def run(argv: list[str]) -> None:
    """Find tools and write their masks."""
    args = parse(Masks, argv, "masks", HELP)
    if args.tool:
        _add_clicked(args)
    else:
        _find_all(args)
    say(f"look at {args.data / SHEET}; correct masks: {command('view', args.data)}")


def _find_all(args: Masks) -> None:
    """Find the tools of every frame."""
    from ..core.config import DataConfig
    from ..data import load_sequence
    from ..data.folder_edits import note_found_masks, replace_masks, writable_masks
    from ..data.found_tools import FrameRow, uncertain_frames, write_rows
    from ..prepare.networks import open_sam2
    from ..tool_masks.mask_store import MaskStore
    from ..visualization.image_tools import mask_sheet, write_png

    sequence = load_sequence(args.data, DataConfig())
    writable_masks(sequence)
    shown = set(spread(len(sequence), SHOWN))
    rows, pictures = list[FrameRow](), []
    with TemporaryDirectory(prefix="endoprior-") as work, Counting() as progress:
        camera = sequence.camera(0)
        masks = MaskStore(Path(work) / "masks", (camera.width, camera.height))
        segmenter = None if args.segmenter is None else open_sam2(args.segmenter, "--with")
        found_frames = _found(sequence, segmenter, args.refine, Path(work) / "carried", progress)
        for i, (mask, found) in enumerate(found_frames):
            masks.put(i, mask)
            rows.append(FrameRow.of(i, found))
            if i in shown:
                pictures.append((sequence.frame(i).rgb_u8, found.mask, f"{i}: {rows[i].share:.1%}"))
        replace_masks(sequence, masks)
    write_png(args.data / SHEET, mask_sheet(pictures, COLUMNS, WIDTH_PX))
    write_rows(args.data, rows)
    with_tools = [row for row in rows if row.share]
    note_found_masks(args.data, len(with_tools) / len(rows), segmenter.name if segmenter else "")
    say(f"tools in {len(with_tools)} of {len(rows)} frames, at most {max(row.share for row in rows):.1%} of a frame")
    if uncertain := uncertain_frames(rows):
        say(f"uncertain: frames {number_ranges(uncertain)}")


def _add_clicked(args: Masks) -> None:
    """Add the tools at the points of `--tool` to the masks of all frames."""
    if args.refine or args.segmenter is not None:
        other = "--refine" if args.refine else "--with"
        fix = f"Find the tools first: `{command('masks', args.data, other)}`."
        raise input_error("--tool", f"no {other}", other, fix)
    from ..core.config import DataConfig
    from ..data import load_sequence
    from ..data.folder_edits import replace_masks, writable_masks
    from ..data.found_tools import read_rows, write_rows
    from ..tool_masks.clicked_tools import find_clicked, parse_click
    from ..tool_masks.mask_store import MaskStore
    from ..visualization.image_tools import mask_sheet, write_png

    sequence = load_sequence(args.data, DataConfig())
    writable_masks(sequence)
    clicks = [parse_click(text, "--tool") for text in args.tool]
    shown = {*spread(len(sequence), SHOWN), *(click.frame for click in clicks)}
    changed, pictures = dict[int, float](), []
    with TemporaryDirectory(prefix="endoprior-") as work, Counting() as progress:
        camera = sequence.camera(0)
        masks = MaskStore(Path(work), (camera.width, camera.height))
        for step in find_clicked(sequence, clicks, lambda i: ~sequence.frame(i).tissue_mask):
            progress("finding the tool", step.done, step.total)
            if step.added is None:
                continue
            i, frame = step.frame, sequence.frame(step.frame)
            mask = ~frame.tissue_mask | step.added
            if step.added.any() or not sequence.mask_files:
                masks.put(i, mask)
                changed[i] = float(step.added.mean())
            if i in shown:
                pictures.append((frame.rgb_u8, mask, f"{i}: +{step.added.mean():.1%}"))
        replace_masks(sequence, masks)
    write_png(args.data / SHEET, mask_sheet(pictures, COLUMNS, WIDTH_PX))
    if rows := read_rows(args.data):
        write_rows(args.data, [row.with_added(changed.get(row.frame, 0.0)) for row in rows])
    frames = [i for i, share in changed.items() if share]
    say(f"added in {len(frames)} of {len(sequence)} frames, at most {max(changed.values(), default=0):.1%} of a frame")
    if frames:
        say(f"changed: frames {number_ranges(frames)}")


def _found(
    sequence: FrameSequence, segmenter: VideoSegmenter | None, refine: bool, work: Path, progress: Progress
) -> Iterator[tuple[NDArray[np.bool_], FoundTools]]:
    """The masks and tools of every frame: our own, or those of a segmenter that our own prompt."""
    from ..tool_masks.sequence import find_in_sequence

    if segmenter is None:
        return find_in_sequence(sequence, refine=refine, progress=progress)
    from ..tool_masks.video_segmenter import segment_sequence

    return segment_sequence(sequence, segmenter, work, refine=refine, progress=progress)
