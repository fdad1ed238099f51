"""`endoprior scale DATA`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..core.checks import input_error
from ..core.shell import command
from ..system.console import say
from .arguments import Command


@dataclass
class Scale(Command):
    """Bring the relative depth of a sequence folder to mm, by something of known size in its images.

    Depth, poses and known points are changed all or not at all. Another scale replaces one that was given before.
    """

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    known_length: tuple[str, ...] = field(default=(), metadata={"metavar": "FRAME,X1,Y1,X2,Y2,MM"})
    """Two points of tissue, x, y in px of the frame, from 0, are MM apart. One or more; several are averaged."""
    shaft_mm: float = field(default=0.0, metadata={"metavar": "MM"})
    """Diameter of all instruments' shafts, most often 8 in robotic surgery, else 5. Their tips must touch tissue in
    some frames. Less sure than --known-length."""

    examples = ("DATA --known-length 12,310,205,402,198,20", "DATA --shaft-mm 8")

    def execute(self) -> None:
        """Find the scale and write it."""
        from ..data.edit import finish_scale
        from ..prepare.scale import scale_folder

        if not (self.known_length or self.shaft_mm):
            if finish_scale(self.data):
                say(f"{self.data}: the scale whose change was interrupted is complete now")
                return
            fix = f"`{command('scale', self.data, '--known-length', '12,310,205,402,198,20')}` with your numbers."
            raise input_error("endoprior scale", "--known-length or --shaft-mm", "neither", fix)
        scale = scale_folder(self.data, self.known_length, self.shaft_mm)
        say(f"{self.data}: 1 unit of relative depth is {scale.factor:.4g} mm, by {scale.text}")
        say(f"next: `{command('check', self.data)}`")
