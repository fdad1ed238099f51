"""The steps of a job. A step whose result is there is skipped, so that an interrupted job resumes.

What a step hands on to later ones (`HandedOn`) lives as long as the process: nothing is computed twice. A step that
finds nothing there, because the job was interrupted, computes it itself, with the same result.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..check import Finding, draw_check, find, measure
from ..check.report import as_json, read_findings
from ..core.checks import InputError, input_error, quotation
from ..core.config import Config
from ..core.config_io import from_dict
from ..core.shell import command, command_of, quoted
from ..core.types import Frame
from ..data import FrameSequence, load_sequence
from ..data.description import MOTION, read_description
from ..data.pixels import measured_share
from ..data.reading import read_json
from ..evaluation.context import RenderedFrame, RenderedFrames, SceneFrames
from ..evaluation.registry import all_scores
from ..evaluation.scoring import evaluate, scored_data
from ..evaluation.verdict import Verdict, VerdictFacts, verdict_on
from ..export.html import DEFAULT_TITLE, PageTooLarge, write_html
from ..footage.image_operations import runs
from ..footage.known_facts import KnownFacts
from ..model.scene import RenderedScene, Scene
from ..model.scene_file import load_scene
from ..prepare import prepare
from ..prepare.pipeline import Progress
from ..prepare.scan_figure import draw_scan
from ..runs.folder import CHECKPOINT, CONFIG
from ..runs.log import mask_facts, missed_tools_of
from ..runs.report import write_report
from ..runs.train import TrainingRun, WindowedRun, start_run
from ..system.atomic import write_json
from ..system.console import note_line
from ..system.parallel import Pool, frame_threads
from ..training.trainer import StepReport, Trainer
from ..visualization.image_tools import colorize, label, tile
from ..visualization.rendered_views import depth_span
from ..visualization.video import write_video
from .choice import SCAN
from .job import Job, SequenceJob


@dataclass
class HandedOn:
    """What steps leave for later ones; empty at first."""

    facts: KnownFacts = field(default_factory=KnownFacts)  # of the prepared frames; from `prepare` to `check`
    sequence: FrameSequence | None = None
    """As the training reads it, with the frames that it holds decoded; from `check` to `train`."""
    rendered: RenderedFrames | None = None  # the frames as the scene renders them; from `score` to `video`


PICTURE_BYTES = 60  # memory in which a thread composes an image of the video, bytes for each px of a frame
PLAYER_BYTES = 40_000_000  # largest player
MIN_BYTES = 7  # size of one Gaussian at one time step in the player; at least this (docs/export.md)
TITLE_LETTERS = 150  # in a line above the report
PREVIEW_TITLE = "Preview: small frames, short training. Not for scores."
CODE = re.compile("[a-z]+(-[a-z]+)*")  # names of findings
LOST_FRAMES = 5  # so many frames in a row without a pose: the camera is lost. Fewer are blurred or covered.
MIN_SCENE_FRAMES = 20  # fewer frames are not worth a scene
SHOWN_SCORES = ("psnr_tissue", "ssim", "depth_rmse_mm", "flow_error_dis")


@dataclass(frozen=True)
class Step:
    """One step of a job."""

    name: str
    result: Callable[[SequenceJob], Path]  # file or folder that is there when the step is done
    act: Callable[[SequenceJob, Progress, HandedOn], list[str]]  # does it; returns lines for the user


def run_step(step: Step, job: SequenceJob, progress: Progress, handed_on: HandedOn | None = None) -> list[str] | None:
    """Do a step, and keep what it returns for a resumed job; None if it was done before.

    Args:
        handed_on: what the steps before have left for this one, and gets what it leaves for the next ones.
    """
    if step.result(job).exists():
        return None
    lines = step.act(job, progress, handed_on or HandedOn())
    write_json(job.notes, _stored_notes(job) | {step.name: lines})
    return lines


def notes_of(step: Step, job: SequenceJob) -> list[str]:
    """What a step that was done before returned, as a quotation: the file may come from somebody else."""
    lines = _stored_notes(job).get(step.name)
    return [quotation(str(line)) for line in lines] if isinstance(lines, list) else []


def _stored_notes(job: SequenceJob) -> dict[str, Any]:
    fix = "remove it, and repeat the command: only the notes of steps that are done are lost."
    return read_json(job.notes, fix) if job.notes.is_file() else {}


def _prepare(job: SequenceJob, progress: Progress, handed_on: HandedOn) -> list[str]:
    assert isinstance(job, Job), "a sequence folder is prepared"
    done = prepare(job.source, job.data, job.prepare, progress, handed_on.facts)
    if job.choice:
        choice, figure = job.choice, (job.out / SCAN).with_suffix(".png")
        draw_scan(job.source, choice.scanned, figure, job.prepare.folder_rate, choice.pictures)
    return [f"{done.num_frames} frames of {done.size[0]}x{done.size[1]}", *map(note_line, done.notes)]


def _check(job: SequenceJob, progress: Progress, handed_on: HandedOn) -> list[str]:
    progress("measuring", 0, 0)
    sequence = handed_on.sequence = load_sequence(job.data, job.cfg.data)
    facts = measure(sequence, job.cfg.data, handed_on.facts)
    findings = find(facts)
    draw_check(sequence, facts, findings, job.figure)
    write_json(job.findings, as_json(facts, findings))
    shown = [finding for finding in findings if finding.severity != "note" or finding.code == "windows"]
    return [str(finding) for finding in shown]


def _findings(job: SequenceJob) -> tuple[Finding, ...]:
    return read_findings(job.findings, "remove it, and repeat the command: the sequence is checked again.")


def problems(job: SequenceJob) -> str:
    """Which errors and warnings `check` found, and the command that prints their fixes; empty without any.

    What the file says is not repeated: it may come from somebody else.
    """
    found = [finding for finding in _findings(job) if finding.severity != "note"]
    codes = dict.fromkeys(finding.code for finding in found if CODE.fullmatch(finding.code))
    paint = f"To paint tools: `{command('view', job.data)}`. " if "tool-fraction" in codes else ""
    fix = f"{paint}How to fix it: `{command('check', job.data)}`"
    return f"Found by check: {', '.join(codes)}. {fix}" if codes else ""


def start_training(
    job: SequenceJob, sequence: FrameSequence | None = None
) -> tuple[TrainingRun | WindowedRun, list[str]]:
    """The run of a job, new or resumed, and lines for the user. Args: sequence: as the job reads it, if it is open."""
    sequence = sequence or load_sequence(job.data, job.cfg.data)
    cfg, notes, usable = job.cfg, list[str](), (0, len(sequence))
    if isinstance(job, Job):
        unexplained = read_description(job.data / "sequence.json").get("unexplained_frames", [])
        cuts = [frame for finding in _findings(job) if finding.code == "scene-cut" for frame in finding.frames]
        demand_known_motion(job, sequence, unexplained)
        usable = usable_frames(len(sequence), unexplained, cuts)
    first, end = usable
    if end - first < len(sequence):
        skipped = f"0-{first - 1}" if first > 1 else "0" * first
        cfg = replace(cfg, data=replace(cfg.data, first_frames=end, skip_frames=skipped))
        sequence = load_sequence(job.data, cfg.data)
        why = "the camera is lost, or the scene changes, before and after"
        notes = [f"training uses frames {first}-{end - 1}, the longest stretch: {why}"]
    begun = (job.run / CHECKPOINT).is_file() or (job.run / CONFIG).is_file()
    return start_run(sequence, cfg, job.run, resume=begun, say=lambda _text: None), notes


def demand_known_motion(job: Job, sequence: FrameSequence, unexplained: list[int]) -> None:
    """Raise InputError if no camera serves any frames, unless the user chose the part of the video."""
    is_chosen = job.choice is None or "--segment" in job.options
    if is_chosen or sequence.sources.get(MOTION) != "unknown" or len(unexplained) < len(sequence):
        return
    start, end = job.part.start, job.part.start + len(sequence) / job.part.frames_per_second
    forced = {**job.options, "--start": (f"{start:.4g}",), "--end": (f"{end:.4g}",)}
    again = command_of("run", (job.source, job.out.with_name(f"{job.out.name}_forced")), forced)
    want = "frames that camera poses link, or in which the view rests"
    got = f"neither in {start:.1f}-{end:.1f} s: how the camera moves is unknown, and no model is possible"
    fix = "Choose another part (--segment, or --start and --end), or a higher --frames-per-second"
    raise input_error(job.source, want, got, f"{fix}. To train on this part all the same: `{again}`.")


def _train(job: SequenceJob, progress: Progress, handed_on: HandedOn) -> list[str]:
    run, notes = start_training(job, handed_on.sequence)
    handed_on.sequence = None  # the run has it, and what it decoded
    num_windows, before, last = len(run.waiting(job.run)) if isinstance(run, WindowedRun) else 1, 0, 0

    def observer(_report: StepReport, trainer: Trainer) -> None:
        nonlocal before, last
        done, total = trainer.progress()
        before, last = before + (total if done < last else 0), done
        progress("training", before + done, max(num_windows * total, before + total))

    progress("starting", 0, 0)
    scene = run.complete(observer)
    return [*notes, f"{len(_of_gaussians(scene)):,} Gaussians"]


def _of_gaussians(scene: RenderedScene) -> Scene:
    assert isinstance(scene, Scene), "a job trains Gaussians"
    return scene


def _score(job: SequenceJob, progress: Progress, handed_on: HandedOn) -> list[str]:
    codes = tuple(finding.code for finding in _findings(job))
    progress("rendering held-out frames", 0, 0)
    scene = _of_gaussians(load_scene(job.run))
    sequence = _frames_of(job, scene.config)
    result = evaluate(scene, sequence, networks=False, speed=not job.is_preview)
    handed_on.rendered = result.rendered
    result.protocol |= mask_facts(job.run)
    missed, left_out, count = missed_tools_of(job.run) or [], sequence.left_out, len(sequence)
    # Where any frame shows a resting view, only those are used, and one camera is right for them.
    is_unknown = sequence.sources.get(MOTION) == "unknown" and not left_out
    facts = VerdictFacts(
        share_used=1 - len(left_out) / count,
        share_with_missed_tools=len(missed) / count,
        lengths_are_relative=sequence.depth_is_relative,
        depth_is_guessed=sequence.depth_is_guessed,
        depth_measured=measured_share(sequence.frames("test")),
        motion_is_unknown=is_unknown,
        findings=codes,
    )
    result.verdict = verdict_on(result.scores, facts)
    result.save(job.run)
    title = [f"{result.verdict.plain}.", *wrap(f"Verdict: {result.verdict}", TITLE_LETTERS)]
    title += [PREVIEW_TITLE] * job.is_preview
    write_report(scene, sequence, job.run, job.report, "\n".join(title))
    known = [all_scores()[name] for name in SHOWN_SCORES if name in result.scores]
    shown = [f"{score.label} {score.text(result.scores[score.name], sequence.depth_is_relative)}" for score in known]
    return [f"held-out frames: {', '.join(shown)}"]


def verdict_of(job: SequenceJob) -> Verdict | None:
    """The verdict on the model of a job; None of one that another version made."""
    file = job.run / "metrics.json"
    fix = f"remove it and {quoted(job.report)}, and repeat the command: the model is scored again."
    stored = read_json(file, fix).get("verdict") if file.is_file() else None
    try:
        verdict = from_dict(Verdict, stored)
    except InputError:
        return None
    return replace(verdict, reasons=tuple(map(quotation, verdict.reasons)), plain=quotation(verdict.plain))


def _render_video(job: SequenceJob, progress: Progress, handed_on: HandedOn) -> list[str]:
    scene = _of_gaussians(load_scene(job.run))
    rendered = handed_on.rendered or _rendered(job, scene)
    frames, left_out = rendered.sequence.frames("video"), set(rendered.sequence.left_out)
    span = depth_span(scene)

    def picture(seen: tuple[Frame, RenderedFrame]) -> NDArray[np.uint8]:
        frame, view = seen
        name = "EndoPrior-GS" + (" (frame not used)" if frame.index in left_out else "")
        shown = {"input": frame.rgb_u8, name: view.rgb_u8, "depth": colorize(view.depth, *span, view.depth > 0)}
        return tile([label(image, name) for name, image in shown.items()], len(shown))

    def images(pool: Pool) -> Iterator[NDArray[np.uint8]]:
        views = ((frame, rendered[frame.index]) for frame in frames)  # rendering has threads of its own
        for k, image in enumerate(pool.map(picture, views)):
            yield image
            progress("rendering", k + 1, len(frames))

    first = scene.cameras[0]
    with frame_threads(PICTURE_BYTES * first.width * first.height) as pool:
        write_video(job.rendered_video, images(pool), scene.frames_per_second)
    handed_on.rendered = None
    return []


def _rendered(job: SequenceJob, scene: Scene) -> RenderedFrames:
    """The frames of a job, in the poses in which the scene was trained."""
    sequence = _frames_of(job, scene.config).with_poses(scene.cameras)
    return RenderedFrames(SceneFrames(scene, sequence), sequence, "test")


def _player(job: SequenceJob, progress: Progress, _handed_on: HandedOn) -> list[str]:
    progress("packing", 0, 0)
    scene = _of_gaussians(load_scene(job.run))
    at_a_time = len(scene) / len(scene.windows)
    left_out = {scene.frame_time(i) for i in _frames_of(job, scene.config).left_out}

    def shown(most: float) -> list[float]:
        """Times of at most so many frames, none of which was left out of the training, if any other is there."""
        every = every_kth_time(len(scene.cameras), most)
        return [time for time in every if time not in left_out] or every

    times = shown(PLAYER_BYTES / (at_a_time * MIN_BYTES))
    title = f"{DEFAULT_TITLE} (preview)" if job.is_preview else DEFAULT_TITLE  # never the name of the video
    verdict = verdict_of(job)
    remark = " ".join([f"{verdict.plain}."] * bool(verdict.plain) + [f"Verdict: {verdict}"]) if verdict else ""
    while not job.player.exists():
        try:
            write_html(scene, job.player, title=title, remark=remark, times=times, max_bytes=PLAYER_BYTES)
        except PageTooLarge as error:  # its size is known only when part of it is packed
            if len(times) == 1:
                raise
            times = shown(len(times) * PLAYER_BYTES / error.num_bytes)
    skipped = [f"{len(left_out)} frames without a camera pose, or of another scene, are not shown"] if left_out else []
    if len(times) + len(left_out) == len(scene.cameras):
        return skipped
    size = f"{PLAYER_BYTES / 1e6:.0f} MB"
    return [*skipped, f"{len(times)} of {len(scene.cameras)} frames, so that the page stays below {size}"]


STEPS = (
    Step("prepare", lambda job: job.data, _prepare),
    Step("check", lambda job: job.findings, _check),
    Step("train", lambda job: job.run / "scene.safetensors", _train),
    Step("score", lambda job: job.report, _score),
    Step("video", lambda job: job.rendered_video, _render_video),
    Step("player", lambda job: job.player, _player),
)  # in order. Every result is written completely or not at all.


def steps_of(job: SequenceJob) -> tuple[Step, ...]:
    """The steps that a job needs: a sequence folder is not prepared."""
    return STEPS if isinstance(job, Job) else STEPS[1:]


def _frames_of(job: SequenceJob, cfg: Config) -> FrameSequence:
    return load_sequence(job.data, scored_data(cfg.data))


def every_kth_time(num_frames: int, most: float) -> list[float]:
    """Times in [0, 1) of every k-th frame, with the smallest k that gives at most `most` of them, or one."""
    return [i / num_frames for i in range(0, num_frames, math.ceil(num_frames / max(int(most), 1)))]


def usable_frames(num_frames: int, unexplained: list[int], cuts: list[int]) -> tuple[int, int]:
    """First frame, and the frame after the last one, of the longest stretch with a camera pose and without a cut.

    Single frames without a pose do not end it. If it is too short, all frames are used.

    Args:
        unexplained: frames without a camera pose, or of another color than the clip.
        cuts: first frames after a scene cut, from a file that may come from somebody else.
    """
    missing = np.zeros(num_frames, bool)
    missing[unexplained] = True
    ends = np.zeros(num_frames + 1, bool)
    ends[[0, *(cut for cut in cuts if 0 < cut < num_frames), num_frames]] = True
    for first, end in runs(missing):
        if end - first >= LOST_FRAMES or first == 0 or end == num_frames:
            ends[first : end + 1] = True
    first, end = max(pairwise(np.flatnonzero(ends).tolist()), key=lambda part: part[1] - part[0])
    return (first, end) if end - first >= MIN_SCENE_FRAMES else (0, num_frames)
