"""What to do with one video: its part, its settings, and where the results go."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..core.checks import input_error
from ..core.config import Config
from ..core.config_io import to_dict
from ..core.shell import command
from ..data.files import read_json
from ..prepare.config import PrepareConfig
from ..prepare.first_pass import source_facts
from ..prepare.source import open_source
from ..system.atomic import reject_occupied, write_json
from .part import Part, choose_part

SETTINGS = "settings.json"
"""File in the output folder with everything that decides the results; a resumed job must have the same."""
MOST_FRAMES = 300
PREVIEW_FRAMES = 60
PREVIEW_WIDTH = 320
"""Width of the frames of a preview, px."""


@dataclass(frozen=True)
class Job:
    """One video on its way to a scene. Results are in `out`."""

    video: Path
    out: Path
    prepare: PrepareConfig
    """Options of `prepare`, for `part` only."""
    cfg: Config
    part: Part

    @property
    def data(self) -> Path:
        """The sequence folder."""
        return self.out / "data"

    @property
    def run(self) -> Path:
        """The run folder: scene, scores, log, checkpoints."""
        return self.out / "run"

    @property
    def figure(self) -> Path:
        """The figure of `check`."""
        return self.out / "check.png"

    @property
    def findings(self) -> Path:
        """Facts and findings of `check`."""
        return self.out / "check.json"

    @property
    def report(self) -> Path:
        """One image of held-out frames, curves and scores."""
        return self.out / "report.png"

    @property
    def rendered_video(self) -> Path:
        """Input, rendered model and depth beside each other."""
        return self.out / "video.mp4"

    @property
    def player(self) -> Path:
        """The page that plays the scene in a browser."""
        return self.out / "player.html"


def make_job(video: Path, out: Path, prepare: PrepareConfig, cfg: Config, *, preview: bool = False) -> Job:
    """Choose the part of the video and the sizes.

    Args:
        prepare: the user's options; frame rate and end are filled in.
        preview: at most `PREVIEW_FRAMES` frames of at most `PREVIEW_WIDTH` px.
    Raises:
        InputError: the video cannot be read.
    """
    source = open_source(video, prepare.folder_rate)
    rate, most = source.frames_per_second, PREVIEW_FRAMES if preview else MOST_FRAMES
    part = choose_part(source.seconds, rate, prepare.frames_per_second, prepare.start, prepare.end, most)
    width = min(prepare.max_width or PREVIEW_WIDTH, PREVIEW_WIDTH) if preview else prepare.max_width
    chosen = replace(prepare, frames_per_second=part.frames_per_second, end=part.end, max_width=width)
    return Job(video, out, chosen, cfg, part)


def settings(job: Job) -> dict[str, Any]:
    """Everything that decides the results of a job."""
    return {"video": source_facts(job.video), "prepare": repr(job.prepare), "config": to_dict(job.cfg)}


def open_folder(job: Job) -> None:
    """Create the output folder, or accept that of an interrupted job with the same settings.

    Raises:
        InputError: the folder holds something else.
    """
    file, wanted = job.out / SETTINGS, settings(job)
    if file.is_file():
        if read_json(file) != json.loads(json.dumps(wanted)):
            fix = f"Choose another folder: `{command('run', job.video, Path('OUT2'))}`."
            raise input_error(job.out, "results of the same video and options", "others", fix)
        return
    reject_occupied(job.out)
    job.out.mkdir(parents=True, exist_ok=True)
    write_json(file, wanted)
