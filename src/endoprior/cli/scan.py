"""`endoprior scan VIDEO [OUT.json]`: what a video shows, and which parts of it can become a model."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import check_range, input_error
from ..core.shell import command
from ..system.console import say
from .arguments import Command
from .paths import require_writable_folder
from .progress import Counting

if TYPE_CHECKING:
    from ..prepare.segments import Stretch

MAX_LISTED = 12


@dataclass
class Scan(Command):
    """Look through a whole video quickly: which segments can become a model, and what is wrong with the rest.

    Writes OUT.json, and its timeline as OUT.png. Nothing else is kept, and your video never leaves this computer.
    """

    video: Path = field(metadata={"place": "VIDEO"})
    """Video file, or folder of images."""
    out: Path = field(default=Path("scan.json"), metadata={"place": "OUT.json"})
    """File to write; the timeline goes beside it."""
    folder_rate: float | None = None
    """Frame rate of a folder of images, 1/s; without it that of its sequence.json, else 25."""

    examples = ("video.mp4", "video.mp4 OUT.json")

    def __post_init__(self) -> None:
        if self.folder_rate is not None:
            check_range("folder_rate", self.folder_rate, 0.01, 1000)

    def execute(self) -> None:
        """Scan, write both files, and list the segments."""
        from ..prepare.scan import scan_video
        from ..prepare.scan_figure import draw_scan
        from ..prepare.segments import as_json, best_segment, from_json, segments_of
        from ..system.atomic import write_json

        if self.out.suffix.lower() != ".json":
            raise input_error("OUT.json", "a name that ends in .json", str(self.out), f"`{self.out}.json`.")
        require_writable_folder("OUT.json", self.out.parent)
        with Counting() as progress:
            scan = scan_video(self.video, self.folder_rate, lambda done, whole: progress("scan", int(done), int(whole)))
        scanned = as_json(scan)
        stretches = from_json(scanned)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.out, scanned)
        figure = self.out.with_suffix(".png")
        draw_scan(self.video, scanned, figure, self.folder_rate, scan.pictures)
        segments = segments_of(stretches)
        unusable = sum(each.seconds for each in stretches if each.reason)
        say(f"{self.video}: {scan.seconds:.1f} s, {len(segments)} segments; {unusable:.1f} s are in none")
        best = best_segment(segments) if segments else -1
        for line in stretch_lines(stretches, best):
            say(line)
        say(f"{self.out}, {figure}")
        say(f"next: `{command('run', self.video, 'OUT')}`, or another segment with --segment")


def stretch_lines(stretches: list[Stretch], best: int) -> list[str]:
    """The stretches of a video in words, the longest `MAX_LISTED` of them, in order."""
    number, shown = 0, []
    for each in stretches:
        number += not each.reason
        span = f"{each.start:.1f}-{each.end:.1f} s"
        is_best = number - 1 == best
        what = each.reason or f"segment {number}, score {each.score:.1f}" + (" (best)" if is_best else "")
        shown.append((each.seconds, f"  {span:>16}  {what}"))
    longest = sorted(shown, key=lambda line: -line[0])[:MAX_LISTED]
    lines = [line for entry in shown if entry in longest for line in [entry[1]]]
    rest = len(shown) - len(lines)
    return [*lines, *([f"  and {rest} shorter parts"] if rest > 0 else [])]
