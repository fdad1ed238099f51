"""`endoprior run VIDEO OUT`; and many jobs one after the other, or on a Ray cluster, with progress and a table."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..core.shell import changed_options, command, command_of
from ..data.image_folders import beside
from ..data.load import is_prepared
from ..model.presets import preset, preset_names
from ..prepare.config import PrepareConfig
from ..prepare.notes import asks_for_action
from ..system.console import say
from .arguments import Command
from .devices import Wanted, with_device
from .paths import require_input_first, require_writable_folder
from .progress import duration, step_head, step_progress
from .train import require_gaussians

if TYPE_CHECKING:
    from ..evaluation.verdict import Verdict
    from ..pipeline import Job, SequenceJob
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

from .progress import Counting

if TYPE_CHECKING:
    from ..pipeline import Entry, Outcome


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
        from ..pipeline import Job, open_folder, problems, verdict_of
        from ..runs.log import missed_tools_line

        began = clock.perf_counter()
        if self.all_segments:
            return self._run_all()
        job = self.job(say)
        resumes = open_folder(job)
        say(_part_words(job) if isinstance(job, Job) else f"{job.source}: a sequence folder, trained as it is")
        _do_steps(job, resumes=resumes, verbose=self.verbose)
        say(f"\n{last_words(verdict_of(job), duration(clock.perf_counter() - began), job.player)}")
        for line in result_lines(job):
            say(f"  {line}")
        for line in filter(None, (problems(job), missed_tools_line(job.run, job.data))):
            say(line)
        say(f"To turn and measure it: `{command('view', job.run)}`")
        say(
            f"To see it in 3D Slicer: `{command('export', job.run, job.out / 'tissue.mrb')}`, and drop that file there."
        )
        if isinstance(job, Job) and job.is_preview:
            whole = {name: words for name, words in job.options.items() if name != "--preview"}
            say(f"The whole model: `{command_of('run', (self.video, beside(job.out, 'whole')), whole)}`")

    def job(self, tell: Callable[[str], None]) -> SequenceJob:
        """The job that the arguments ask for; `tell` takes the device that trains, and the reason."""
        from ..pipeline import SequenceJob, make_job

        require_input_first("run", self.video, self.out)
        is_ready = is_prepared(self.video)
        chosen = ["--segment"] * bool(self.segment) + ["--all-segments"] * self.all_segments
        if chosen and (other := {"--start", "--end", "--stir"} & {*changed_options(self.config)}):
            raise input_error(chosen[0], f"no {min(other)}", f"{chosen[0]} and {min(other)}", "Remove one of them.")
        if is_ready and (useless := ["--preview"] * self.preview + chosen + list(changed_options(self.config))):
            fix = f"Remove {useless[0]}{', or use `--preset preview`' * self.preview}."
            raise input_error(useless[0], "a video to prepare", f"{self.video}, a sequence folder", fix)
        cfg = replace(preset("preview" if self.preview else self.preset), seed=self.seed)
        require_gaussians(cfg, "`endoprior prepare VIDEO DATA`, then `train`, `eval` and `render`.")
        cfg = with_device(cfg, self.device, tell)
        if is_ready:
            return SequenceJob(self.video, self.out, cfg)
        return make_job(
            self.video, self.out, self.config, cfg, preset=self.preset, preview=self.preview, segment=self.segment
        )

    def _run_all(self) -> int:
        """The segments one after the other, in folders of `out`; 1 if one failed."""
        if is_prepared(self.video) or {"--start", "--end", "--stir"} & {*changed_options(self.config)}:
            self.job(say)  # says what contradicts
        require_writable_folder("OUT", self.out)
        from ..pipeline import Entry
        from ..pipeline.choice import SCAN, choose_segment
        from ..system.atomic import write_json

        choice = choose_segment(self.video, self.out, self.config.folder_rate)
        self.out.mkdir(parents=True, exist_ok=True)
        write_json(self.out / SCAN, choice.scanned)  # where the jobs find it
        numbers = range(1, len(choice.segments) + 1) if choice.number else [0]
        entries = [
            Entry(name, replace(self, out=self.out / name, segment=number, all_segments=False).job(say))
            for number in numbers
            for name in [f"segment_{number}" if number else "whole"]
        ]
        return do_all(entries, self.out, str(self.video))


def _do_steps(job: SequenceJob, *, resumes: bool, verbose: bool) -> None:
    """Say how long it will take, compile kernels if that was not done, and do the steps that are left."""
    from ..pipeline import (
        COMPILE,
        Forecast,
        HandedOn,
        notes_of,
        parts_of,
        removed_if_rejected,
        run_step,
        steps_of,
    )  # fmt: skip
    from ..runs import kernel_cache

    steps = steps_of(job)
    waiting, names = [step for step in steps if not step.result(job).exists()], [step.name for step in steps]
    if resumes:
        say(resume_words(names, [step.name for step in waiting]))
    first = [COMPILE] if waiting and not kernel_cache.is_filled(job.cfg) else []
    names, handed_on = first + names, HandedOn()
    forecast = Forecast(parts_of(job, first + [step.name for step in waiting]))
    if waiting:
        say(f"about {duration(forecast.left())} in all")

    def shown(name: str) -> AbstractContextManager[Counting]:
        forecast.begin(name)
        return step_progress(names, name, lambda *news: forecast.after(name, *news))

    try:
        with removed_if_rejected(job):
            for name in first:
                with shown(name) as progress:
                    kernel_cache.fill(job.cfg, progress=lambda *done: progress("kernels, once", *done))
            for step in steps:
                if step in waiting:
                    with shown(step.name) as progress:
                        lines = run_step(step, job, progress, handed_on)
                else:
                    say(f"{step_head(names, step.name):<13} done before")
                    lines = notes_of(step, job)
                for line in shown_lines(lines or [], verbose=verbose):
                    say(f"     {line}")
    except KeyboardInterrupt:
        say("Stopped. To resume, run the same command again.")
        raise


def _part_words(job: Job) -> str:
    """What is used of the video."""
    part = job.part
    seconds = part.num_frames / part.frames_per_second
    words = f"{job.source}: {part.num_frames} frames, {seconds:.1f} s at {part.frames_per_second:g} frames/s"
    words += " (its rate is unknown: set it with --folder-rate)" if job.rate_is_assumed else ""
    if not part.is_whole:
        words += f" from {part.start:g} s on (--start and --end choose another part)"
    return "\n".join([*(job.choice.words(job.source, job.out, job.options) if job.choice else []), words])


def shown_lines(lines: Iterable[str], *, verbose: bool) -> list[str]:
    """Of the lines of a step those to print: `verbose`, or all but the notes that ask for no action."""
    return [line for line in lines if verbose or asks_for_action(line)]


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


def resume_words(names: list[str], waiting: list[str]) -> str:
    """Where a job goes on, and what is there already."""
    done = ", ".join(name for name in names if name not in waiting) or "nothing"
    return f"Resuming at {waiting[0]}; done before: {done}." if waiting else f"All done before: {done}."


def do_all(entries: Sequence[Entry], out: Path, title: str, ray: str | None = None) -> int:
    """Do jobs one after the other, or on a Ray cluster, and write their table into `out`; 1 if one failed."""
    from ..pipeline import SUMMARY, TABLE, run_here, run_on, write_summary
    from ..runs import kernel_cache
    from ..runs.folder import LOCK
    from ..system.file_lock import locked
    from ..system.ray_cluster import connected

    require_writable_folder("OUT", out)
    waiting = [entry for entry in entries if not entry.is_done]
    say(f"{title}: {len(entries)} jobs, {len(entries) - len(waiting)} done before")
    for entry in waiting:
        kernel_cache.fill(entry.job.cfg, say)
    outcomes = []
    with connected(ray, say) if ray and waiting else nullcontext() as cluster:
        out.mkdir(parents=True, exist_ok=True)
        with locked(out, out / LOCK):
            try:
                for outcome in run_on(cluster, entries, say) if cluster else run_here(entries, _shown):
                    _tell(outcome)
                    outcomes.append(outcome)
            except KeyboardInterrupt:
                say("Stopped. To resume, run the same command again.")
                raise
            outcomes.sort(key=lambda outcome: entries.index(outcome.entry))
            lines = write_summary(outcomes, out)
    for line in ("", *lines, f"\nThis table: {out / SUMMARY}; all scores: {out / TABLE}"):
        say(line)
    return 1 if any(outcome.failure for outcome in outcomes) else 0


def _shown(entry: Entry, step: str) -> AbstractContextManager[Counting]:
    """The progress of a step of a job in this process."""
    from ..pipeline import steps_of

    names = [f"{entry.name}: {each.name}" for each in steps_of(entry.job)]
    return step_progress(names, f"{entry.name}: {step}")


def _tell(outcome: Outcome) -> None:
    """Say how a job ended, with the notes of its steps."""
    from ..pipeline import notes_of, steps_of

    entry = outcome.entry
    if outcome.failure:
        say(f"{entry.name}: failed: {outcome.failure}")
        return
    say(f"{entry.name}: done: {entry.job.out}")
    for step in steps_of(entry.job):
        for line in shown_lines(notes_of(step, entry.job), verbose=False):
            say(f"     {line}")
