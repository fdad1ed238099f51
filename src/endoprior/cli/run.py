"""`endoprior run VIDEO OUT`: from a video to a model to look at."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..core.shell import changed_options, command, command_of
from ..data.image_folders import beside
from ..data.load import is_prepared
from ..model.presets import preset, preset_names
from ..prepare.config import PrepareConfig
from ..system.console import say
from .arguments import Command
from .devices import Wanted, with_device
from .jobs import do_all, do_job
from .paths import require_input_first, require_writable_folder
from .progress import duration
from .train import require_gaussians

if TYPE_CHECKING:
    from ..evaluation.verdict import Verdict
    from ..pipeline import Job, SequenceJob

PART_OPTIONS = {"--start", "--end", "--stir"}
"""Options that choose a part of the video."""


@dataclass
class Run(Command):
    """From a video to a model to look at, in one command: prepare, check, train, score, video and player.

    OUT gets player.html (open it in a browser), video.mp4, report.png, check.png, data/ and run/. To resume after an
    interruption, run the same command again. Your video never leaves this computer.
    """

    video: Path = field(metadata={"place": "VIDEO"})
    """Video file, folder of images and masks, or sequence folder, which is not prepared again."""
    out: Path = field(metadata={"place": "OUT"})
    """Folder for the results: new, empty, or resumed."""
    preview: bool = False
    """A first look in less than a minute on two cores: at most 60 frames, 320 px wide. Not for scores."""
    segment: int = 0
    """Segment of `endoprior scan` to use, from 1; 0 is the best one. --start or --end choose any part."""
    all_segments: bool = False
    """A model of every segment, each in a folder of its own in OUT, as `endoprior batch` makes them."""
    preset: str = field(default="default", metadata={"choices": preset_names()})
    """Preset of the training; --preview has its own."""
    seed: int = 0
    """Seed of the training."""
    device: Wanted = "auto"
    """Device that trains; auto uses CUDA only if all of it works (`endoprior doctor`)."""
    verbose: bool = False
    """Print the notes that ask for no action too; OUT/notes.json has all of them."""
    config: PrepareConfig = field(default_factory=PrepareConfig, metadata={"name": ""})

    examples = ("video.mp4 OUT --preview", "video.mp4 OUT", "stereo.mp4 OUT --calibration calib.yaml")
    basics = "--preview --segment --all-segments --start --end --calibration --right --depth --masks --preset --verbose"

    def execute(self) -> int | None:
        """Do every step, with one progress display."""
        from ..pipeline import Job, open_folder, verdict_of

        if self.all_segments:
            return self._run_all()
        began = clock.perf_counter()
        job = self.job(say)
        resumes = open_folder(job)
        say(_part_words(job) if isinstance(job, Job) else f"{job.source}: a sequence folder, trained as it is")
        do_job(job, resumes=resumes, verbose=self.verbose)
        say(f"\n{last_words(verdict_of(job), duration(clock.perf_counter() - began), job.player)}")
        for line in (*(f"  {line}" for line in result_lines(job)), *_problem_lines(job), *self._next_lines(job)):
            say(line)

    def job(self, tell: Callable[[str], None]) -> SequenceJob:
        """The job that the arguments ask for; `tell` takes the device that trains, and the reason."""
        from ..pipeline import SequenceJob, make_job

        self._reject_contradictions()
        cfg = replace(preset("preview" if self.preview else self.preset), seed=self.seed)
        require_gaussians(cfg, "`endoprior prepare VIDEO DATA`, then `train`, `eval` and `render`.")
        cfg = with_device(cfg, self.device, tell)
        if is_prepared(self.video):
            return SequenceJob(self.video, self.out, cfg)
        return make_job(
            self.video, self.out, self.config, cfg, preset=self.preset, preview=self.preview, segment=self.segment
        )

    def _reject_contradictions(self) -> None:
        """Raise InputError where paths or options contradict each other."""
        require_input_first("run", self.video, self.out)
        changed = changed_options(self.config)
        chosen = ["--segment"] * bool(self.segment) + ["--all-segments"] * self.all_segments
        if chosen and (other := PART_OPTIONS & {*changed}):
            raise input_error(chosen[0], f"no {min(other)}", f"{chosen[0]} and {min(other)}", "Remove one of them.")
        useless = ["--preview"] * self.preview + chosen + list(changed)
        if useless and is_prepared(self.video):
            fix = f"Remove {useless[0]}{', or use `--preset preview`' * self.preview}."
            raise input_error(useless[0], "a video to prepare", f"{self.video}, a sequence folder", fix)

    def _run_all(self) -> int:
        """The segments one after the other, in folders of `out`; 1 if one failed."""
        from ..pipeline import Entry
        from ..pipeline.choice import SCAN, choose_segment
        from ..system.atomic import write_json

        self._reject_contradictions()
        require_writable_folder("OUT", self.out)
        choice = choose_segment(self.video, self.out, self.config.folder_rate)
        self.out.mkdir(parents=True, exist_ok=True)
        write_json(self.out / SCAN, choice.scanned)  # where the jobs find it
        segments = {f"segment_{number}": number for number in range(1, len(choice.segments) + 1)}
        entries = [
            Entry(name, replace(self, out=self.out / name, segment=number, all_segments=False).job(say))
            for name, number in (segments if choice.number else {"whole": 0}).items()
        ]
        return do_all(entries, self.out, str(self.video))

    def _next_lines(self, job: SequenceJob) -> list[str]:
        """The commands that make more of the model."""
        from ..pipeline import Job

        slicer = command("export", job.run, job.out / "tissue.mrb")
        lines = [
            f"To turn and measure it: `{command('view', job.run)}`",
            f"To see it in 3D Slicer: `{slicer}`, and drop that file there.",
        ]
        if isinstance(job, Job) and job.is_preview:
            whole = {name: words for name, words in job.options.items() if name != "--preview"}
            lines.append(f"The whole model: `{command_of('run', (self.video, beside(job.out, 'whole')), whole)}`")
        return lines


def _part_words(job: Job) -> str:
    """What is used of the video."""
    part = job.part
    seconds = part.num_frames / part.frames_per_second
    words = f"{job.source}: {part.num_frames} frames, {seconds:.1f} s at {part.frames_per_second:g} frames/s"
    words += " (its rate is unknown: set it with --folder-rate)" if job.rate_is_assumed else ""
    if not part.is_whole:
        words += f" from {part.start:g} s on (--start and --end choose another part)"
    return "\n".join([*(job.choice.words(job.source, job.out, job.options) if job.choice else []), words])


def last_words(verdict: Verdict | None, took: str, player: Path) -> str:
    """How a run ended, what it is good for before all figures: a model that is wrong is not called done."""
    plain = [f"{verdict.plain}."] if verdict and verdict.plain else []
    head = f"The model is wrong (after {took})" if verdict and verdict.word == "wrong" else f"Done in {took}"
    figures = [f"Verdict: {verdict}."] if verdict else []
    return "\n".join([*plain, f"{head}. Open {player} in a browser.", *figures])


def result_lines(job: SequenceJob) -> list[str]:
    """What each result is."""
    results = {
        "report": (job.report, "held-out frames, their errors, curves and scores in one image"),
        "video": (job.rendered_video, "input, rendered model and depth beside each other"),
        "scene": (job.run, "the model itself, for `endoprior view` and `endoprior export`"),
        "check": (job.figure, "what is suspicious in the video"),
        "notes": (job.notes, "what each step decided"),
    }
    width = max(len(str(path)) for path, _ in results.values())
    return [f"{name:<8}{path!s:<{width}}  {what}" for name, (path, what) in results.items()]


def _problem_lines(job: SequenceJob) -> list[str]:
    """What is wrong with the model, one line each."""
    from ..pipeline import problems
    from ..runs.log import missed_tools_line

    return [line for line in (problems(job), missed_tools_line(job.run, job.data)) if line]
