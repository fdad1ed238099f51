"""What a benchmark compares; `spec_file` reads it."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from endoprior.core.config import Config
from endoprior.core.config_io import from_dict, override, to_dict
from endoprior.phantom import PhantomConfig

from .method import PICTURES, method_named

Expectation = Literal["better", "no worse", "no effect"]


@dataclass(frozen=True)
class SequenceSpec:
    """One sequence: a folder, or a phantom that the benchmark writes."""

    path: str = ""
    """Sequence folder; `~` and `$NAME` are expanded, a relative one starts at the spec's folder."""
    phantom: PhantomConfig | None = None
    """Fields of the phantom; in place of `path`."""
    shrink: int = 1
    """Divides width and height."""
    first_frames: int = 0
    """Number of frames to read; 0 reads all."""
    stride: int = 0
    """Read every n-th frame; 0 is the dataset's published stride."""
    format: str = "auto"
    """Layout of the folder (docs/datasets.md)."""
    masks: Literal["given", "found"] = "given"
    """`found`: train with tool masks found from the footage; the sequence's own ones are the truth of all scores."""
    poses: Literal["given", "estimated"] = "given"
    """`estimated`: train with a camera path estimated from the footage; the sequence's own one is that of scores."""
    folds: tuple[int, ...] = (0,)
    """Values of `data.test_phase`: every cell is trained and scored once for each, with other frames held out."""

    @property
    def reading(self) -> dict[str, Any]:
        """The fields of `DataConfig` that it sets."""
        return {"shrink": self.shrink, "first_frames": self.first_frames, "stride": self.stride, "format": self.format}

    def reading_of(self, fold: int) -> dict[str, Any]:
        """`reading` with the frames of a fold held out; fold 0, the published split, adds nothing."""
        return self.reading | ({"test_phase": fold} if fold else {})

    @property
    def found_parts(self) -> dict[str, str]:
        """What methods train with in place of the sequence's own: `{"masks": "found", "poses": "estimated"}`."""
        return {part: how for part, how in (("masks", self.masks), ("poses", self.poses)) if how != "given"}


@dataclass(frozen=True)
class MatchSpec:
    """How the growth threshold of a method is found: by one of these. See `matched_count`."""

    count_of: str = ""
    """Method of the spec: end with as many Gaussians as it does, mean over seeds."""
    growth: float = 0.0
    """End with this many times the first Gaussians."""
    value_of: str = ""
    """Method of the spec with a search of its own: use the threshold that it finds."""


@dataclass(frozen=True)
class PublishedSpec:
    """The published table that a spec repeats; `published` writes both side by side."""

    table: str
    """Start of `source` in published.csv."""
    data: str
    """Its `data` there. The figures are means over the sequences of the spec."""
    size: tuple[int, int]
    """Width and height of the published frames, px; others are said in the report."""
    frames: dict[str, int] = field(default_factory=dict)
    """Number of frames of a sequence; with another one it is not the published sequence."""
    differs: tuple[str, ...] = ()
    """What is done in another way here, one sentence each."""


@dataclass(frozen=True)
class MethodSpec:
    """One method: a preset, a method of another package, or the images of another program; and its changes."""

    preset: str = ""
    """One of our presets; `default` if no method and no pictures are named."""
    method: str = ""
    """A name that `endoprior plugins` lists."""
    pictures: dict[str, str] = field(default_factory=dict)
    """Folder of rendered frames by sequence; as `SequenceSpec.path`, `{seed}`, `{fold}` stand for seed and fold."""
    depth_pictures: dict[str, str] = field(default_factory=dict)
    """Folder of rendered depth by sequence."""
    depth_scale: float = 0.0
    """mm per unit of that depth, where it is PNG."""
    set: dict[str, Any] = field(default_factory=dict)
    """Config fields by dotted name, on top of the benchmark's own `set` and `set_for`."""
    label: str = ""
    """Name in tables; the method's own if empty."""
    match: MatchSpec | None = None
    """Search for `density.grow_threshold`, on each sequence with the first seed; the others use what is found."""
    published: str = ""
    """Its name in published.csv."""
    only_if_named: bool = False
    """Leave it out unless `--methods` names it."""

    @property
    def name(self) -> str:
        """Name in the registry of methods."""
        return PICTURES if self.pictures else self.method or self.preset or "default"

    def differs_by_seed(self, sequence: str) -> bool:
        """Whether there is more than one result on a sequence: images without `{seed}` are one result."""
        return not self.pictures or "{seed}" in self.pictures.get(sequence, "")

    def differs_by_fold(self, sequence: str) -> bool:
        """Whether there is more than one fold of a sequence: images without `{fold}` are of one training."""
        return not self.pictures or "{fold}" in self.pictures.get(sequence, "")


@dataclass(frozen=True)
class ClaimSpec:
    """A statement that the results are checked against."""

    score: str
    method: str
    than: str
    expect: Expectation = "better"
    by: float = 0.0
    """The claimed difference; for `no effect` and `no worse`, the largest that is still allowed.

    In the score's unit, or relative: see `Score.compare`.
    """
    text: str = ""
    """Source of the claim."""
    budget: int | None = None
    """Only cells of this budget; None takes all."""


@dataclass(frozen=True)
class Spec:
    """methods x sequences x folds x budgets x seeds, one protocol."""

    title: str
    sequences: dict[str, SequenceSpec]
    methods: dict[str, MethodSpec]
    about: str = ""
    """Text above the tables: sizes, reductions and their reasons."""
    budgets: tuple[int, ...] = ()
    """Initial Gaussians; empty: each method's own."""
    seeds: tuple[int, ...] = (0,)
    set: dict[str, Any] = field(default_factory=dict)
    """Config fields by dotted name, for all methods with our config: presets, and others that take a `Config`."""
    set_for: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Options for all methods of one name, such as a preset's; a method's own `set` comes last."""
    scores: tuple[str, ...] = ("psnr_tissue", "ssim", "depth_rmse_mm", "flow_error_dis", "num_gaussians")
    """Columns of the tables."""
    claims: tuple[ClaimSpec, ...] = ()
    figures: tuple[Literal["budgets", "curves", "frames", "instability", "prior", "sides"], ...] = ("curves", "frames")
    compare_with: str = ""
    """Reference of the paired differences; the first method if empty."""
    networks: bool = False
    """Also compute the scores that need a network (RAFT, LPIPS), if their weights are found."""
    protocols: tuple[str, ...] = ()
    """Also score as these papers did; each protocol has tables of its own (docs/scores.md)."""
    published: PublishedSpec | None = None
    iterations: int = 0
    """Length of every training with our config, in place of the method's own; 0 keeps that."""
    folder: str = "."
    """Base of relative paths: the folder of the spec file."""

    @property
    def reference(self) -> str:
        """Reference of the paired differences."""
        return self.compare_with or next(iter(self.methods))

    def label(self, method: str) -> str:
        """Name of a method in tables."""
        return self.methods[method].label or method

    def with_own_parts(self, sequence: str) -> str | None:
        """The sequence that differs from one with `found_parts` in having its own; None if there is none."""
        chosen = self.sequences[sequence]
        own = replace(chosen, masks="given", poses="given")
        others = {name: replace(other, folds=chosen.folds) for name, other in self.sequences.items()}
        return next((name for name, other in others.items() if own == other != chosen), None)

    def folds(self, sequence: str, method: str) -> tuple[int, ...]:
        """The folds of a sequence that a method has results of."""
        folds = self.sequences[sequence].folds
        return folds if self.methods[method].differs_by_fold(sequence) else folds[:1]

    def has_config(self, method: str) -> bool:
        """Whether the options of a method are our `Config`, with budgets and the spec's `set`."""
        return isinstance(method_named(self.methods[method].name).options, Config)

    def config(
        self, method: str, sequence: str, budget: int | None, seed: int, threshold: float | None = None, fold: int = 0
    ) -> Any:
        """The full options of one cell: a `Config`, or the dataclass of a method that has options of its own.

        Args:
            threshold: of growth, of a method that has a `MatchSpec`; None is its own.
        Raises:
            InputError: an override names no field, or has a value of the wrong kind.
        """
        chosen, has_config = self.methods[method], self.has_config(method)
        options = method_named(chosen.name).options
        values = to_dict(options)
        for where, overrides in (
            ("set", self.set if has_config else {}),
            (f"set_for.{chosen.name}", self.set_for.get(chosen.name, {})),
            (f"methods.{method}.set", chosen.set),
        ):
            override(values, overrides, where)
        if has_config:
            override(values, {"iterations": self.iterations} if self.iterations else {}, "iterations")
            values["data"] |= self.sequences[sequence].reading | {"test_phase": fold}
            if budget is not None:
                values["init"]["budget"] = budget
            values["seed"] = seed
        if threshold is not None:
            values["density"]["grow_threshold"] = threshold
        if chosen.pictures:
            folders = {"folder": chosen.pictures, "depth_folder": chosen.depth_pictures}
            values |= {name: self._folder(paths.get(sequence, ""), seed, fold) for name, paths in folders.items()}
            values |= {"depth_scale": chosen.depth_scale, "name": self.label(method)}
        return from_dict(type(options), values, f"methods.{method}")

    def _folder(self, path: str, seed: int, fold: int) -> str:
        """A folder of images; empty if there is none."""
        named = path.replace("{seed}", str(seed)).replace("{fold}", str(fold))
        return str(self.resolved(named).absolute()) if path else ""

    def resolved(self, path: str) -> Path:
        """A path of the spec: `~` and `$NAME` expanded, relative to the spec's folder."""
        expanded = Path(os.path.expandvars(path)).expanduser()
        return expanded if expanded.is_absolute() else Path(self.folder) / expanded


@dataclass(frozen=True)
class SpecSelection:
    """Which part of a spec to run."""

    methods: tuple[str, ...] = ()
    """Names in the spec; empty: all that need not be named."""
    seeds: tuple[int, ...] = ()
    """Empty: those of the spec."""
    iterations: int = 0
    """See `Spec.iterations`."""

    def of(self, spec: Spec) -> Spec:
        """The part of a spec, with the claims that are left; it may have no methods."""
        methods = {
            name: about
            for name, about in spec.methods.items()
            if (name in self.methods if self.methods else not about.only_if_named)
        }
        claims = tuple(claim for claim in spec.claims if {claim.method, claim.than} <= methods.keys())
        than = spec.compare_with if spec.compare_with in methods else ""
        seeds, iterations = self.seeds or spec.seeds, self.iterations or spec.iterations
        return replace(spec, methods=methods, claims=claims, compare_with=than, seeds=seeds, iterations=iterations)


@dataclass(frozen=True)
class Cell:
    """One run of the matrix."""

    sequence: str
    method: str
    budget: int | None
    seed: int
    fold: int = 0
    """`data.test_phase`: which frames are held out."""

    @property
    def name(self) -> str:
        """Unique within the matrix."""
        budget = "" if self.budget is None else f"@{self.budget}"
        fold = f"/fold{self.fold}" if self.fold else ""
        return f"{self.sequence}/{self.method}{budget}/seed{self.seed}{fold}"


def cells(spec: Spec) -> list[Cell]:
    """All cells; seeds vary slowest, so that an unfinished matrix has whole seeds."""
    return [
        Cell(sequence, method, budget, seed, fold)
        for seed in spec.seeds
        for sequence, chosen in spec.sequences.items()
        for fold in chosen.folds
        for budget in (spec.budgets or (None,))
        for method, about in spec.methods.items()
        if (seed == spec.seeds[0] or about.differs_by_seed(sequence)) and fold in spec.folds(sequence, method)
    ]


def sequence_folder(spec: Spec, name: str, out: Path) -> Path:
    """Folder of a sequence: the user's, or the phantom's below `out`."""
    sequence = spec.sequences[name]
    if sequence.phantom:
        fields = json.dumps(to_dict(sequence.phantom), sort_keys=True)
        return out / "sequences" / f"phantom-{hashlib.sha256(fields.encode()).hexdigest()[:8]}"
    return spec.resolved(sequence.path)
