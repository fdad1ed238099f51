"""`endoprior prepare VIDEO OUT`."""

from __future__ import annotations

import sys
import time as clock
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..prepare.config import PrepareConfig
from .parsing import parse
from .progress import PLAIN_EVERY_SECONDS, say


@dataclass
class Prepare:
    """Write a sequence folder from an endoscope video: eyes split and rectified, borders cut, depth, tool masks, poses.

    Give the same command again to go on after an interruption. Nothing is sent anywhere; no metadata is copied.
    """

    video: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="VIDEO")]]
    """Video file, or folder of pictures."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Sequence folder to write; must be new or empty."""
    config: Annotated[PrepareConfig, tyro.conf.arg(name="")] = field(default_factory=PrepareConfig)


def run(argv: list[str]) -> None:
    """Prepare the sequence."""
    args = parse(Prepare, argv, "prepare")
    from ..prepare import prepare

    with _progress() as progress:
        done = prepare(args.video, args.out, args.config, progress)
    for remark in done.remarks:
        say(f"note: {remark}")
    say(f"{done.out}: {done.num_frames} frames of {done.size[0]}x{done.size[1]}")
    say(f"next: endoprior check {done.out}; endoprior train {done.out} RUN")


class _progress:
    """A line every few seconds, or one line that is written over on a terminal."""

    def __enter__(self) -> _progress:
        self._terminal, self._what = sys.stderr.isatty(), ""
        self._began = self._last = clock.monotonic()
        self._first = 0
        return self

    def __exit__(self, *exc: object) -> None:
        if self._terminal and self._what:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def __call__(self, what: str, done: int, total: int) -> None:
        now = clock.monotonic()
        if what != self._what:
            self._what, self._began, self._first = what, now, done
            if not self._terminal:
                say(f"{what} ...")
        elif not self._terminal and now - self._last < PLAIN_EVERY_SECONDS and done < total:
            return
        self._last = now
        rate = (done - self._first) / max(now - self._began, 1e-9)
        line = f"{what} {done}/{total or '?'}"
        if rate > 0 and total:
            line += f"  {rate:.1f} frames/s  {(total - done) / rate:.0f} s left"
        if self._terminal:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
        elif done:
            say(line)
