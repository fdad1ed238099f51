"""What is scored, and what a scorer gets to see: frames, rendered frames, the scene if any, and where scores go."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.types import to_uint8
from ..data import FrameList, FrameSequence, Split
from ..data.reading import of_type, read_own, read_parts
from ..model.scene import RenderedScene, Scene
from ..system.atomic import write_json
from ..system.memory import BoundedCache, cache_bytes
from .score import ScoreUnavailable, mean_over_frames
from .verdict import Verdict

OUTLIER_DB = 3.0  # A frame whose PSNR lies this far below the median of its split is an outlier
EXACT = "infinite: the rendered frames equal the true ones exactly"
"""Why there is no PSNR where no frame has any error; black frames, for example."""
NETWORKS_OFF = "network scores were not asked for"
SPEED_OFF = "the speed of rendering was not asked for"
NO_SCENE = "needs a scene; there are rendered images only"
TOO_SLOW = "needs other frames of the video, which a radiance field renders for hours on a CPU"
NO_GAUSSIANS = "needs the Gaussians of a scene; this one has none"
NO_DEPTH = "needs depth, which was not rendered for every frame"
Rendering = tuple[NDArray[np.float32], NDArray[np.float32] | None]
"""Color (H, W, 3) in [0, 1], and depth (H, W) in mm as z, 0 where nothing is; None for no depth."""


class Reconstruction(Protocol):
    """The result of a method, as it is scored. `SceneFrames` makes one of a scene.

    It may have an attribute `provenance`, a dict in JSON's types, which is saved in `metrics.json` beside the scores.
    """

    def render(self, index: int) -> Rendering:
        """Frame `index` of the sequence, 0-based, at its time and from its camera, without tool; ScoreUnavailable where
        there is none: scores that need it are skipped with this reason.
        """
        ...


@dataclass(frozen=True)
class SceneFrames:
    """A scene, rendered at the times and from the cameras of a sequence."""

    scene: RenderedScene
    sequence: FrameSequence

    def render(self, index: int) -> Rendering:
        """See `Reconstruction.render`."""
        frame = self.sequence.frame(index)
        out = self.scene.render_with_smoke(frame.time, frame.camera)
        return out.color.cpu().numpy(), out.depth.cpu().numpy()


@dataclass(frozen=True)
class RenderedFrame:
    """One rendered frame."""

    split_color: NDArray[np.float32] | None  # `color`, or None outside of the split, to save memory
    rgb_u8: NDArray[np.uint8]  # (H, W, 3) rounded to 8 bits: what the published protocol scores
    rendered_depth: NDArray[np.float32] | None  # (H, W) z, mm; None if there is none

    @property
    def color(self) -> NDArray[np.float32]:
        """(H, W, 3) in [0, 1], not rounded; of frames of the split only."""
        assert self.split_color is not None, "this frame is outside of the split"
        return self.split_color

    @property
    def rgb(self) -> NDArray[np.float32]:
        """(H, W, 3) `rgb_u8` in [0, 1]."""
        return np.asarray(self.rgb_u8 / np.float32(255), np.float32)

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) z, mm; of a scene the sum of weight * z. ScoreUnavailable without rendered depth."""
        if self.rendered_depth is None:
            raise ScoreUnavailable(NO_DEPTH)
        return self.rendered_depth

    @property
    def nbytes(self) -> int:
        """Memory it takes."""
        return sum(array.nbytes for array in (self.split_color, self.rgb_u8, self.rendered_depth) if array is not None)


class RenderedFrames:
    """Rendered frames by index: each is rendered when first asked for, and kept as memory allows."""

    def __init__(self, reconstruction: Reconstruction, sequence: FrameSequence, split: Split) -> None:
        self._reconstruction, self.sequence = reconstruction, sequence
        self._scored = set(sequence.indices(split))
        self._cache: BoundedCache[RenderedFrame] = BoundedCache(cache_bytes(), lambda rendered: rendered.nbytes)

    def __getitem__(self, index: int) -> RenderedFrame:
        return self._cache.get(index, lambda: self._render(index))

    def _render(self, index: int) -> RenderedFrame:
        color, depth = self._reconstruction.render(index)
        camera, problem = self.sequence.camera(index), ""
        size = camera.height, camera.width
        for name, array, shape in (("depth", depth, size), ("color", color, (*size, 3))):
            if array is not None and (array.shape != shape or array.dtype != np.float32):
                problem = f"expected {name} of shape {shape} and type float32, got {array.shape} and {array.dtype}"
        if not problem and not (color.min() >= 0 and color.max() <= 1):  # NaN fails too
            problem = f"expected color in [0, 1], got {color.min():g} to {color.max():g}"
        if problem:
            maker = type(self._reconstruction).__name__
            raise InputError(f"{maker}.render({index}): {problem}. Fix: Correct the method that returned it.")
        return RenderedFrame(color if index in self._scored else None, to_uint8(color), depth)


@dataclass
class Evaluation:
    """Scores of one scene on one split."""

    protocol: dict[str, Any]
    scores: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    """Why a score has no value, by name."""
    per_frame: list[dict[str, Any]] = field(default_factory=list)
    """One row for each frame of the split: `index`, `time`, and the scores that a single frame has."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where rendered images come from, for `metrics.json`; a scene has its `config.json`."""
    verdict: Verdict | None = None
    """How good the model is, in a word, with its reasons."""
    protocols: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By name of another paper's protocol: its `tags`, `scores` and `skipped`; see `protocols.score_protocols`."""
    rendered: RenderedFrames | None = field(default=None, repr=False)
    """The frames that were rendered to be scored, to show them without rendering them again."""

    def add(self, name: str, value: float, reason: str = "not finite") -> None:
        """Record a score, or `reason` where it is not finite; an int stays one."""
        if math.isfinite(value):
            self.scores[name] = value if isinstance(value, int) else float(value)
        else:
            self.skipped[name] = reason

    def outlier_frames(self) -> list[int]:
        """Frames whose `psnr_tissue` lies more than `OUTLIER_DB` below the median of the split."""
        scored = [(row["index"], row["psnr_tissue"]) for row in self.per_frame if row.get("psnr_tissue") is not None]
        median = float(np.median([value for _, value in scored])) if scored else 0.0
        return [index for index, value in scored if value < median - OUTLIER_DB]

    def save(self, folder: str | Path) -> Path:
        """Write `metrics.json`, which is returned, and `per_frame.json`; `metrics_SPLIT.json` of another split."""
        suffix = "" if self.protocol["split"] == "test" else f"_{self.protocol['split']}"
        folder = Path(folder)
        file = folder / f"metrics{suffix}.json"
        facts = {name: getattr(self, name) for name in ("protocol", "scores", "skipped")}
        if self.verdict is not None:
            facts["verdict"] = asdict(self.verdict)
        write_json(file, facts | ({"protocols": self.protocols} if self.protocols else {}) | self.provenance)
        write_json(folder / f"per_frame{suffix}.json", self.per_frame)
        return file


SCORED_AGAIN = "remove it, and score again: `endoprior eval RUN`, or the same `run` or `bench` command."


def read_scores(file: Path, fix: str = SCORED_AGAIN) -> dict[str, Any]:
    """What `Evaluation.save` wrote to `metrics.json`, or the like of masks."""
    stored = read_parts(file, {"scores": dict[str, float]}, fix)
    others = {"skipped": dict[str, str], "protocol": dict[str, Any]}
    return stored | {name: of_type(file, hint, stored.get(name, {}), name, fix) for name, hint in others.items()}


def read_frame_scores(file: Path, fix: str = SCORED_AGAIN) -> tuple[dict[str, float], ...]:
    """What it wrote to `per_frame.json`: `index`, `time` and scores of each frame."""
    rows = read_own(file, tuple[dict[str, float], ...], fix)
    if not all(row.get("index", 0.5) % 1 == 0 for row in rows):
        raise input_error(file, "an index in each row", "none", fix)
    return rows


@dataclass(frozen=True)
class EvaluationContext:
    """One evaluation, as every scorer's `compute` takes it."""

    reconstruction: Reconstruction
    sequence: FrameSequence
    split: Split
    networks: bool
    """Whether scores that need a network may be computed."""
    weights_dir: Path | None
    """Folder to look for network weights in first."""
    result: Evaluation
    """Where scores go; `add`, `add_mean`, `add_frames` and `skip` write to it."""
    given_path: NDArray[np.float64] | None = None
    """(T, 4, 4) camera-to-world, mm: stands in for the true path where there is none."""
    speed: bool = True
    """Whether to time the rendering, which takes a second or more."""
    download: bool = False
    """Whether weights that are not on this machine may be downloaded."""

    @cached_property
    def true_path(self) -> NDArray[np.float64] | None:
        """(T, 4, 4) camera-to-world, mm, to compare the scene's cameras with; None without."""
        true = None if self.sequence.truth is None else self.sequence.truth.camera_to_world
        return self.given_path if true is None else true

    @cached_property
    def frames(self) -> FrameList:
        """Frames of the split."""
        return self.sequence.frames(self.split)

    @property
    def video(self) -> FrameList:
        """All frames of the sequence, for scores that render each; ScoreUnavailable where that would take hours."""
        self.reject_slow_frames()
        return self.sequence.frames("video")

    def reject_slow_frames(self) -> None:
        """ScoreUnavailable where rendering frames beside those of the split would take hours."""
        scene = self.reconstruction.scene if isinstance(self.reconstruction, SceneFrames) else None
        if scene is not None and not isinstance(scene, Scene) and scene.device.type == "cpu":
            raise ScoreUnavailable(TOO_SLOW)

    @cached_property
    def rendered(self) -> RenderedFrames:
        """All frames of the sequence as they are rendered, by index."""
        return RenderedFrames(self.reconstruction, self.sequence, self.split)

    def tissue_color(self, index: int) -> NDArray[np.float32]:
        """(H, W, 3) rendered color of a frame without smoke, rounded to 8 bits, in [0, 1]."""
        scene = self.reconstruction.scene if isinstance(self.reconstruction, SceneFrames) else None
        frame = self.sequence.frame(index)
        if scene is None or scene.smoke_at(frame.time) is None:
            return self.rendered[index].rgb
        rgb_u8 = to_uint8(scene.render(frame.time, frame.camera).color.cpu().numpy())
        return np.asarray(rgb_u8 / np.float32(255), np.float32)

    @property
    def rendered_scene(self) -> RenderedScene:
        """What renders the tissue from any camera; ScoreUnavailable where only rendered images are scored."""
        if not isinstance(self.reconstruction, SceneFrames):
            raise ScoreUnavailable(NO_SCENE)
        return self.reconstruction.scene

    @property
    def scene(self) -> Scene:
        """The Gaussians and their motion; ScoreUnavailable for rendered images, or a scene without Gaussians."""
        scene = self.rendered_scene
        if not isinstance(scene, Scene):
            raise ScoreUnavailable(NO_GAUSSIANS)
        return scene

    def add(self, name: str, value: float, reason: str = "not finite") -> None:
        """See `Evaluation.add`."""
        self.result.add(name, value, reason)

    def skip(self, name: str, reason: str) -> None:
        """Record why a score has no value."""
        self.result.skipped[name] = reason

    def add_mean(self, name: str, values: Sequence[float], reason: str) -> None:
        """Record the mean of the finite `values`, or `reason` where there is none."""
        self.add(name, mean_over_frames(values), EXACT if math.inf in values else reason)

    def add_frames(self, rows: Sequence[dict[str, float]], reason: str) -> None:
        """Record scores that every frame has, one row by name for each frame of the split: finite values in
        `per_frame`, their mean, or `reason`, as the score.
        """
        for stored, row in zip(self.result.per_frame, rows, strict=True):
            stored |= {name: float(value) for name, value in row.items() if math.isfinite(value)}
        for name in rows[0]:
            self.add_mean(name, [row[name] for row in rows], reason)

    @contextmanager
    def skip_if_unavailable(self, *names: str) -> Iterator[None]:
        """Turn `ScoreUnavailable` into the reason why those of these scores that have no value have none."""
        try:
            yield
        except ScoreUnavailable as reason:
            for name in names:
                if name not in self.result.scores:
                    self.skip(name, str(reason))
