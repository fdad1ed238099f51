"""The rendered frames of another program as a method: nothing is trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from endoprior.data import FrameSequence
from endoprior.evaluation.pictures import Pictures


@dataclass(frozen=True)
class PictureOptions:
    """Where the files are; see `Pictures`."""

    folder: str = ""
    """Color; empty if there are none of this sequence."""
    depth_folder: str = ""
    """Depth; empty if there is none."""
    depth_scale: float = 0.0
    """mm per unit of PNG depth; 0 if there is none."""
    name: str = ""


class PictureMethod:
    """See `Method`."""

    options = PictureOptions()

    def train(self, sequence: FrameSequence, options: PictureOptions, *, seed: int, out: Path) -> Pictures:
        """Find the files of the test frames; seed and folder are not used."""
        depth = Path(options.depth_folder) if options.depth_folder else None
        about = {"depth_folder": depth, "depth_scale": options.depth_scale or None, "name": options.name}
        return Pictures(Path(options.folder), sequence, "test", **about)
