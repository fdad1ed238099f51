"""What to do with one video or sequence folder: its part, its settings, and where the results go."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ..core.config import Config
from ..core.options import Options, changed_options
from ..prepare.camera_path.sequence_path import WITHOUT_COLMAP
from ..prepare.config import PrepareConfig
from ..prepare.source import open_source
from .part import Part, choose_part

MOST_FRAMES = 10_000
USUAL_FRAMES = 300
"""A video with more frames loses some in between, as long as tissue can be followed."""
PREVIEW_FRAMES = 60
PREVIEW_WIDTH = 320
"""Width of the frames of a preview, px."""


@dataclass(frozen=True)
class SequenceJob:
    """A sequence folder on its way to a scene. Results are in `out`."""

    source: Path
    """What the user gave: the sequence folder."""
    out: Path
    cfg: Config
    options: Options
    """What the user chose, as it is typed; all else follows from it: `{"--preview": (), "--end": ("2.5",)}`."""

    @property
    def is_preview(self) -> bool:
        """Whether it is a first look: few and small frames, a short training."""
        return False

    @property
    def data(self) -> Path:
        """The sequence folder."""
        return self.source

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
    def notes(self) -> Path:
        """What each finished step told the user."""
        return self.out / "notes.json"

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


@dataclass(frozen=True)
class Job(SequenceJob):
    """A video on its way to a scene; it is prepared first."""

    prepare: PrepareConfig
    """Options of `prepare`, for `part` only."""
    part: Part

    @property
    def is_preview(self) -> bool:
        """See `SequenceJob`."""
        return "--preview" in self.options

    @property
    def data(self) -> Path:
        """The sequence folder, which `prepare` writes."""
        return self.out / "data"


def make_job(
    video: Path, out: Path, prepare: PrepareConfig, cfg: Config, *, preset: str = "default", preview: bool = False
) -> Job:
    """Choose the part of the video and the sizes.

    Args:
        prepare: the user's options; frame rate and end are filled in.
        preset: what the user calls `cfg`; a preview has its own.
        preview: at most `PREVIEW_FRAMES` frames of at most `PREVIEW_WIDTH` px, and no COLMAP unless it is asked for.
    Raises:
        InputError: the video cannot be read.
    """
    source = open_source(video, prepare.folder_rate)
    rate = source.frames_per_second
    most, usual = (PREVIEW_FRAMES, PREVIEW_FRAMES) if preview else (MOST_FRAMES, USUAL_FRAMES)
    part = choose_part(source.times, rate, prepare.frames_per_second, prepare.start, prepare.end, most, usual)
    width = min(prepare.max_width or PREVIEW_WIDTH, PREVIEW_WIDTH) if preview else prepare.max_width
    poses = WITHOUT_COLMAP["auto"] if preview and prepare.poses == "auto" else prepare.poses
    chosen = replace(prepare, frames_per_second=part.frames_per_second, end=part.end, max_width=width, poses=poses)
    options: Options = {"--preview": ()} if preview else {"--preset": (preset,)} if preset != "default" else {}
    options |= {"--seed": (str(cfg.seed),)} if cfg.seed else {}
    return Job(video, out, cfg, options | changed_options(prepare), chosen, part)
