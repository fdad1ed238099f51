"""What a benchmark compares: a YAML or TOML file, checked completely before anything runs."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..core.config_io import from_dict, override, to_dict
from ..core.presets import PresetName, preset
from ..data.formats import FORMATS
from ..data.reading import read_text
from ..data.yaml_text import load_yaml
from ..evaluation.registry import all_scores
from ..phantom import PhantomConfig

Expectation = Literal["better", "no worse", "no effect"]
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
"""Names of methods and sequences become folders."""
MOST_EXTENDED = 8
MOST_CELLS = 100_000


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

    @property
    def reading(self) -> dict[str, Any]:
        """The fields of `DataConfig` that it sets."""
        return {"shrink": self.shrink, "first_frames": self.first_frames, "stride": self.stride, "format": self.format}


@dataclass(frozen=True)
class MethodSpec:
    """One method: a preset and its changes."""

    preset: str = "default"
    set: dict[str, Any] = field(default_factory=dict)
    """Config fields by dotted name, on top of the benchmark's own `set` and `set_for`."""
    label: str = ""
    """Name in tables; the method's own if empty."""


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
    """methods x sequences x budgets x seeds, one protocol."""

    title: str
    sequences: dict[str, SequenceSpec]
    methods: dict[str, MethodSpec]
    about: str = ""
    """Text above the tables: sizes, reductions and their reasons."""
    budgets: tuple[int, ...] = ()
    """Initial Gaussians; empty: each method's own."""
    seeds: tuple[int, ...] = (0,)
    set: dict[str, Any] = field(default_factory=dict)
    """Config fields by dotted name, for all methods."""
    set_for: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The same for all methods of a preset; a method's own `set` comes last."""
    scores: tuple[str, ...] = ("psnr_tissue", "ssim", "depth_rmse_mm", "flow_error_dis", "num_gaussians")
    """Columns of the tables."""
    claims: tuple[ClaimSpec, ...] = ()
    figures: tuple[Literal["budgets", "curves", "frames", "instability", "prior"], ...] = ("curves", "frames")
    compare_with: str = ""
    """Reference of the paired differences; the first method if empty."""
    networks: bool = False
    """Also compute the scores that need a network (RAFT, LPIPS), if their weights are found."""
    folder: str = "."
    """Base of relative paths: the folder of the spec file."""

    @property
    def reference(self) -> str:
        """Reference of the paired differences."""
        return self.compare_with or next(iter(self.methods))

    def label(self, method: str) -> str:
        """Name of a method in tables."""
        return self.methods[method].label or method

    def config(self, method: str, sequence: str, budget: int | None, seed: int) -> Config:
        """The full config of one cell.

        Raises:
            InputError: an override names no field, or has a value of the wrong kind.
        """
        chosen, data = self.methods[method], self.sequences[sequence]
        values = to_dict(preset(chosen.preset))
        for where, overrides in (
            ("set", self.set),
            (f"set_for.{chosen.preset}", self.set_for.get(chosen.preset, {})),
            (f"methods.{method}.set", chosen.set),
        ):
            override(values, overrides, where)
        values["data"] |= data.reading
        if budget is not None:
            values["init"]["budget"] = budget
        values["seed"] = seed
        return from_dict(Config, values, f"methods.{method}")


def load_spec(path: Path, data: dict[str, Path] | None = None) -> Spec:
    """Read and check a spec.

    Args:
        path: `.yaml`, `.yml` or `.toml`.
        data: folders of sequences by name; they override those of the file.
    Raises:
        InputError: naming the file, the field, what is expected and what is there.
    """
    values = _read(path)
    try:
        for name in ("title", "sequences", "methods"):
            if not values.get(name):
                raise input_error(name, "an entry", "none", "add it.")
        spec = replace(from_dict(Spec, values, "spec"), folder=str(path.parent))
        for name, folder in (data or {}).items():
            if name not in spec.sequences:
                raise InputError(f"--data {name}: expected one of {', '.join(spec.sequences)}. Fix: correct the name.")
            known = replace(spec.sequences[name], path=str(folder.absolute()), phantom=None)
            spec = replace(spec, sequences=spec.sequences | {name: known})
        _check(spec)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return spec


def _read(path: Path, chain: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Entries of a file and the files it `extends`: later ones override, `set` and `set_for` are merged.

    Raises:
        InputError: a file cannot be read, or extends itself.
    """
    readers = {".yaml": load_yaml, ".yml": load_yaml, ".toml": tomllib.loads}
    if path.suffix not in readers:
        raise input_error(path, "a .yaml or .toml file", f"{path.suffix or 'no suffix'}", "rename it.")
    text = read_text(path, "a readable file", "Correct the path.")
    if path.resolve() in chain:
        raise InputError(f"{path}: expected a file that does not extend itself. Fix: remove one `extends`.")
    if len(chain) >= MOST_EXTENDED:
        raise InputError(f"{path}: expected at most {MOST_EXTENDED} files that extend each other. Fix: merge some.")
    try:
        values = readers[path.suffix](text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # such as a number of 5000 digits
        raise input_error(path, f"valid {path.suffix[1:]}", f"{error}", "correct it.") from None
    extends = values.pop("extends", []) if isinstance(values, dict) else None
    if not isinstance(extends, list) or not all(isinstance(name, str) for name in extends):
        raise input_error(path, "named entries, `extends` a list of files", "something else", "correct it.")
    merged: dict[str, Any] = {}
    for part in [*(_read(path.parent / name, (*chain, path.resolve())) for name in extends), values]:
        both = {k for k in ("set", "set_for") if isinstance(merged.get(k), dict) and isinstance(part.get(k), dict)}
        merged |= {key: merged[key] | value if key in both else value for key, value in part.items()}
    return merged


def _check(spec: Spec) -> None:
    for kind, names in (("sequences", spec.sequences), ("methods", spec.methods)):
        for name in names:
            if not NAME.fullmatch(name):
                raise input_error(kind, "a name of letters, digits and . _ + -", f"{name!r}", "rename it.")
    for name, sequence in spec.sequences.items():
        if bool(sequence.path) == (sequence.phantom is not None):
            raise input_error(f"sequences.{name}", "either path or phantom", "both or none", "keep one.")
        if sequence.phantom and (sequence.shrink > 1 or sequence.first_frames):
            raise InputError(f"sequences.{name}: a phantom has its own size. Fix: remove shrink and first_frames.")
        if sequence.format not in ("auto", *FORMATS):
            want = f"auto, {', '.join(FORMATS)}"
            raise input_error(f"sequences.{name}.format", want, repr(sequence.format), "see docs/datasets.md.")
    for name in spec.set_for:
        if name not in PresetName.__args__:
            raise input_error("set_for", f"one of {', '.join(PresetName.__args__)}", f"{name!r}", "choose one.")
    for name, method in spec.methods.items():
        if method.preset not in PresetName.__args__:
            choice = ", ".join(PresetName.__args__)
            raise input_error(f"methods.{name}.preset", f"one of {choice}", f"{method.preset!r}", "choose one.")
    named = [spec.reference, *(name for claim in spec.claims for name in (claim.method, claim.than))]
    for name in named:
        if name not in spec.methods:
            raise input_error("claims, compare_with", f"one of {', '.join(spec.methods)}", f"{name!r}", "correct it.")
    for name in (*spec.scores, *(claim.score for claim in spec.claims)):
        if name not in all_scores():
            raise input_error("scores, claims", "names of scores", f"{name!r}", "see docs/scores.md.")
    if not spec.seeds or len(set(spec.seeds)) < len(spec.seeds):
        raise input_error("seeds", "different numbers", f"{list(spec.seeds)}", "correct them.")
    count = len(spec.seeds) * len(spec.sequences) * max(len(spec.budgets), 1) * len(spec.methods)
    if count > MOST_CELLS:
        raise input_error("methods x sequences x budgets x seeds", f"at most {MOST_CELLS}", f"{count}", "split.")
    for cell in cells(spec):
        spec.config(cell.method, cell.sequence, cell.budget, cell.seed)


@dataclass(frozen=True)
class Cell:
    """One run of the matrix."""

    sequence: str
    method: str
    budget: int | None
    seed: int

    @property
    def name(self) -> str:
        """Unique within the matrix."""
        budget = "" if self.budget is None else f"@{self.budget}"
        return f"{self.sequence}/{self.method}{budget}/seed{self.seed}"


def cells(spec: Spec) -> list[Cell]:
    """All cells; seeds vary slowest, so that an unfinished matrix has whole seeds."""
    return [
        Cell(sequence, method, budget, seed)
        for seed in spec.seeds
        for sequence in spec.sequences
        for budget in (spec.budgets or (None,))
        for method in spec.methods
    ]


def sequence_folder(spec: Spec, name: str, out: Path) -> Path:
    """Folder of a sequence: the user's, or the phantom's below `out`."""
    sequence = spec.sequences[name]
    if sequence.phantom:
        fields = json.dumps(to_dict(sequence.phantom), sort_keys=True)
        return out / "sequences" / f"{name}-{hashlib.sha256(fields.encode()).hexdigest()[:8]}"
    path = Path(os.path.expandvars(sequence.path)).expanduser()
    return path if path.is_absolute() else Path(spec.folder) / path
