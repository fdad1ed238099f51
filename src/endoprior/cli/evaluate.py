"""`endoprior eval RUN`, `endoprior eval --pictures FOLDER DATA`, and `endoprior eval --masks TRUTH DATA`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..core.checks import input_error
from ..core.shell import command
from ..data import FrameSequence, load_sequence
from ..evaluation.protocols.table import KEYS, SCORES, chosen_protocols
from ..evaluation.registry import all_scores
from ..evaluation.score import GROUPS, Score
from ..system.console import say
from ..system.installation import page
from .arguments import Command
from .devices import Wanted, on_device
from .paths import folder_of, open_scene, require_writable_folder

if TYPE_CHECKING:
    from ..evaluation.context import Evaluation
    from ..model.scene import RenderedScene

BETTER = "\u2191 higher is better, \u2193 lower is better"
MAX_MM_PER_UNIT = 1e6
"""Largest --depth-scale."""
COLUMNS = 3
"""Protocols beside ours in one block, so that lines stay near 100 characters."""
NAME, WIDTH = 18, 21


@dataclass
class Eval(Command):
    """Score a trained scene, another program's images, or tool masks; writes metrics.json and per_frame.json.

    Splits other than test have files of their own: metrics_train.json, per_frame_train.json.
    """

    run: Path = field(metadata={"place": "RUN"})
    """Run folder; with --pictures or --masks the sequence folder."""
    data: Path | None = None
    """Sequence folder. Default: the one the run was trained on."""
    split: Literal["test", "train", "video"] = "test"
    """Frames to score."""
    out: Path | None = None
    """Folder for the two files. Default: RUN, or the folder of --pictures; with --masks none are written."""
    pictures: Path | None = None
    """Score the frames in this folder, PNG of 8 or 16 bits, in place of a run (docs/benchmarks.md)."""
    depth_pictures: Path | None = None
    """Depth of these frames: NPY in mm, or 16-bit PNG with --depth-scale."""
    depth_scale: float | None = None
    """mm per unit of the depth files."""
    masks: Path | None = None
    """Score the tool masks of DATA against the true masks in this folder (docs/scores.md)."""
    name: str = ""
    """Name of the method in metrics.json. Default: that of the folder."""
    protocol: str = ""
    """Also score as other papers did: names such as `endonerf,endogs`, or `all` (docs/scores.md)."""
    networks: bool = True
    """Scores by networks (RAFT, LPIPS). They need their weights."""
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""

    examples = ("RUN", "RUN --split train", "--pictures FOLDER DATA", "--masks TRUTH DATA")

    def execute(self) -> None:
        """Score and print."""
        if self.masks:
            self._score_masks(self.masks)
            return
        reject_missing_weights(self.weights_dir)
        self._how()  # reject an unknown protocol now
        if self.pictures:
            self._score_pictures(self.pictures)
            return
        self._reject(["depth_pictures", "depth_scale", "name"], "--pictures beside it", "a run")
        scene = open_scene(self.run)
        run = folder_of(self.run)
        require_writable_folder("--out" if self.out else "RUN", self.out or run)
        self.score_run(on_device(scene, self.device), run)

    def score_run(self, scene: RenderedScene, run: Path, extra: Mapping[str, float] | None = None) -> Evaluation:
        """Score the `scene` of a run folder, write the two files with these `extra` scores, print a table."""
        from ..evaluation.scoring import SAME_IMAGES, evaluate, scored_data
        from ..runs.folder import sequence_of_run
        from ..runs.log import growth_of, mask_facts

        # Depth is scored against measured depth, even where the run's preset trained on filled-in depth.
        sequence = load_sequence(self.data or sequence_of_run(run), scored_data(scene.config.data))
        result = evaluate(scene, sequence, self.split, **self._how())
        if result.protocol.get("trained_on") == SAME_IMAGES:
            facts = "masks, depth, poses or sequence.json"
            say(f"note: {sequence.path}: {facts} changed since the training; the scores are against them as they are")
        growth = growth_of(run)
        result.scores |= dict(extra or {}) | ({"gaussians_growth": growth.ratio} if growth else {})
        result.protocol |= mask_facts(run)
        see = command("render", run, "--split", self.split)
        self._finish(result, sequence, self.out or run, f". To see them: `{see}`")
        return result

    def _score_pictures(self, folder: Path) -> None:
        """Score the rendered frames in `folder` on the sequence that takes the place of the run."""
        from ..evaluation.pictures import Pictures
        from ..evaluation.scoring import evaluate

        self._reject(["data"], "--pictures FOLDER DATA", "--data as well")
        if self.depth_scale is not None and not 0 < self.depth_scale <= MAX_MM_PER_UNIT:
            want = f"a number above 0, up to {MAX_MM_PER_UNIT:g}"
            raise input_error("--depth-scale", want, f"{self.depth_scale}", "Correct it.")
        out = self.out or folder
        require_writable_folder("--out" if self.out else "--pictures", out)
        sequence = load_sequence(self.run)
        depth = {"depth_folder": self.depth_pictures, "depth_scale": self.depth_scale}
        pictures = Pictures(folder, sequence, self.split, name=self.name, **depth)
        for line in pictures.remarks:
            say(line)
        result = evaluate(pictures, sequence, self.split, **self._how())
        self._finish(result, sequence, out)

    def _score_masks(self, folder: Path) -> None:
        """Score the masks of the sequence that takes the place of the run against the true masks in `folder`."""
        from ..evaluation.true_masks import TrueMasks, score_masks

        others = [each.name for each in fields(self) if each.name not in ("run", "out", "masks")]
        self._reject(others, "--masks TRUTH DATA, with no option but --out", "it beside them")
        if self.out:
            require_writable_folder("--out", self.out)
        sequence = load_sequence(self.run)
        truth = TrueMasks(folder, sequence)
        count = len(truth.indices)
        say(f"{truth.folder}: true masks of {count} of {len(sequence)} frames, {truth.matched_by}")
        say(f"true masks: {truth.polarity}")
        result = score_masks(sequence, truth)
        say(f"\nscores of the tool masks in {count} frames ({BETTER})")
        for line in score_table(result.scores, result.skipped):
            say(line)
        if left_out := result.protocol["share_of_pixels_left_out"]:
            say(f"note: {left_out:.1%} of the pixels do not count: border around the image, or burned-in labels")
        saved = f"all scores: {result.save(self.out)}" if self.out else "to keep the scores: --out FOLDER"
        say(f"{saved}; what they mean: {page('scores.md')}")

    def _finish(self, result: Evaluation, sequence: FrameSequence, out: Path, to_see: str = "") -> None:
        """Write the two files into `out`, and print a table; name frames to look at, and how `to_see` them."""
        file = result.save(out)
        held_out = f"; {sequence.split_rule}" if sequence.test_phase or sequence.left_out else ""
        say(f"\nscores of the {len(sequence.indices(self.split))} {self.split} frames ({BETTER}{held_out})")
        relative = sequence.depth_is_relative
        for line in (*score_table(result.scores, result.skipped, relative), *protocol_table(result, relative)):
            say(line)
        if outliers := result.outlier_frames():
            frames = ", ".join(map(str, outliers))
            say(f"note: tissue PSNR of frames {frames} is more than 3 dB below the median{to_see}")
        say(f"all scores: {file}; what they mean: {page('scores.md')}")

    def _how(self) -> dict[str, Any]:
        """Options of `scoring.evaluate`."""
        protocols = chosen_protocols(self.protocol) if self.protocol else ()
        return {"networks": self.networks, "download": True, "weights_dir": self.weights_dir, "protocols": protocols}

    def _reject(self, names: Sequence[str], expected: str, got: str) -> None:
        """Reject options that would have no effect."""
        for each in fields(self):
            if each.name in names and getattr(self, each.name) != each.default:
                option = f"--{'no-' if each.default is True else ''}{each.name.replace('_', '-')}"
                raise input_error(option, expected, got, f"Remove {option}.")


def reject_missing_weights(folder: Path | None) -> None:
    """Reject a --weights-dir that is no folder."""
    if folder and not folder.is_dir():
        raise input_error(folder, "a folder with weights", "none", "Correct --weights-dir.")


def score_table(scores: Mapping[str, float], skipped: Mapping[str, str], relative: bool = False) -> list[str]:
    """The lines of the table, at most 29 and as many as there are reasons for skipped scores.

    Args:
        skipped: reason by name, of scores that could not be computed.
        relative: whether the scale of the depth is unknown, so that lengths are not in mm.
    """
    lines = []
    shown = [score for score in _known(scores) if score.in_summary or score.stands_for in skipped]
    for group in GROUPS:
        title = group
        for score in shown:
            if score.group == group:
                value, hint = score.text(scores[score.name], relative), _references(score, scores) or score.hint
                label = f"{score.label:<18} "
                lines.append(f"  {title:<7} {label}{value:>{34 - len(label)}} {score.arrow:1}  {hint}".rstrip())
                title = ""
    if relative and any(score.is_length for score in shown):
        lines.append("  rel.: the scale of the depth is unknown. Compare these scores on this sequence only.")
    labels: dict[str, list[str]] = {}  # scores that need the same missing package stand together
    for score in _known(skipped):
        if score.in_summary:
            labels.setdefault(skipped[score.name], []).append(score.label)
    return lines + [f"  not computed: {', '.join(names)}: {reason}" for reason, names in labels.items()]


def _known(names: Mapping[str, object]) -> list[Score]:
    return [score for name, score in all_scores().items() if name in names]


def _references(score: Score, scores: Mapping[str, float]) -> str:
    """What chained optical flow and no motion score, for scores of tracks; what a warp does, for the right eye."""
    if (warp := scores.get(f"{score.name}_warp")) is not None:
        return f"left eye moved by depth {warp:,.{score.digits}f}"
    if f"{score.name}_still" not in scores:
        return ""
    known = {what: scores.get(f"{score.name}_{end}") for end, what in (("dis", "chained flow"), ("still", "no motion"))}
    return ", ".join(f"{what} {value:,.{score.digits}f}" for what, value in known.items() if value is not None)


def protocol_table(result: Evaluation, relative: bool = False) -> list[str]:
    """The lines of the blocks: scores and tags, then what differs and why scores have no value; else nothing."""
    lines: list[str] = []
    ours = {"scores": result.scores, "tags": result.protocol["tags"]}
    scored = [name for name, about in result.protocols.items() if about["tags"]]
    for start in range(0, len(scored), COLUMNS):
        some = {name: result.protocols[name] for name in scored[start : start + COLUMNS]}
        lines += ["", *_block({"ours": ours} | some, relative)]
    left_out: dict[tuple[str, str], list[str]] = {}
    """Scores and reason -> protocols."""
    for name, about in result.protocols.items():
        published = [f"{KEYS[tag]}: {text}" for tag, text in about["paper"].items() if text != about["tags"].get(tag)]
        lines += ["", f"{name}: {about['title']} ({about['source']})", "  as published: " + "; ".join(published)]
        lines += [f"  {sentence}" for sentence in about["differs"]]
        for reason in dict.fromkeys(about["skipped"].values()):
            labels = ", ".join(SCORES[score].label for score, why in about["skipped"].items() if why == reason)
            left_out.setdefault((labels, reason), []).append(name)
    skipped = [f"  not computed: {scores} ({', '.join(who)}): {why}" for (scores, why), who in left_out.items()]
    return [*lines, "", *skipped] if skipped else lines


def _block(columns: Mapping[str, Mapping[str, Any]], relative: bool) -> list[str]:
    rows = [("protocol", [*columns])]
    for name, score in SCORES.items():
        values = [column["scores"].get(name) for column in columns.values()]
        if any(value is not None for value in values[1:]):
            texts = ["-" if value is None else f"{value:,.{score.digits}f}" for value in values]
            rows.append((score.heading(relative), texts))
    rows += [(label, [column["tags"].get(tag, "-") for column in columns.values()]) for tag, label in KEYS.items()]
    return [(label.ljust(NAME) + "".join(f"{text:<{WIDTH - 1}} " for text in texts)).rstrip() for label, texts in rows]
