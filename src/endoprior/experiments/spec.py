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
from ..core.presets import PresetName
from ..data.formats import REGISTRY as LAYOUTS
from ..data.reading import read_text
from ..data.yaml_text import load_yaml
from ..evaluation.protocols.table import ProtocolName
from ..evaluation.registry import all_scores
from ..phantom import PhantomConfig
from .method import PICTURES, REGISTRY

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
    masks: Literal["given", "found"] = "given"
    """`found`: train with tool masks found from the footage; the sequence's own ones are the truth of all scores."""
    poses: Literal["given", "estimated"] = "given"
    """`estimated`: train with a camera path estimated from the footage; the sequence's own one is that of scores."""

    @property
    def reading(self) -> dict[str, Any]:
        """The fields of `DataConfig` that it sets."""
        return {"shrink": self.shrink, "first_frames": self.first_frames, "stride": self.stride, "format": self.format}

    @property
    def found_parts(self) -> dict[str, str]:
        """What methods train with in place of the sequence's own: `{"masks": "found", "poses": "estimated"}`."""
        return {part: how for part, how in (("masks", self.masks), ("poses", self.poses)) if how != "given"}


@dataclass(frozen=True)
class MethodSpec:
    """One method: a preset, a method of another package, or the images of another program; and its changes."""

    preset: str = ""
    """One of our presets; `default` if no method and no pictures are named."""
    method: str = ""
    """A name that `endoprior plugins` lists."""
    pictures: dict[str, str] = field(default_factory=dict)
    """Folder of rendered frames by sequence; as `SequenceSpec.path`, `{seed}` stands for the seed."""
    depth_pictures: dict[str, str] = field(default_factory=dict)
    """Folder of rendered depth by sequence."""
    depth_scale: float = 0.0
    """mm per unit of that depth, where it is PNG."""
    set: dict[str, Any] = field(default_factory=dict)
    """Config fields by dotted name, on top of the benchmark's own `set` and `set_for`."""
    label: str = ""
    """Name in tables; the method's own if empty."""

    @property
    def name(self) -> str:
        """Name in the registry of methods."""
        return PICTURES if self.pictures else self.method or self.preset or "default"

    def differs_by_seed(self, sequence: str) -> bool:
        """Whether there is more than one result on a sequence: images without `{seed}` are one result."""
        return not self.pictures or "{seed}" in self.pictures.get(sequence, "")


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
    """Config fields by dotted name, for all methods with our config: presets, and others that take a `Config`."""
    set_for: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Options for all methods of one name, such as a preset's; a method's own `set` comes last."""
    scores: tuple[str, ...] = ("psnr_tissue", "ssim", "depth_rmse_mm", "flow_error_dis", "num_gaussians")
    """Columns of the tables."""
    claims: tuple[ClaimSpec, ...] = ()
    figures: tuple[Literal["budgets", "curves", "frames", "instability", "prior"], ...] = ("curves", "frames")
    compare_with: str = ""
    """Reference of the paired differences; the first method if empty."""
    networks: bool = False
    """Also compute the scores that need a network (RAFT, LPIPS), if their weights are found."""
    protocols: tuple[ProtocolName, ...] = ()
    """Also score as these papers did; each protocol has tables of its own (docs/scores.md)."""
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
        return next((name for name, other in self.sequences.items() if own == other != chosen), None)

    def has_config(self, method: str) -> bool:
        """Whether the options of a method are our `Config`, with budgets and the spec's `set`."""
        return isinstance(REGISTRY.load(self.methods[method].name).options, Config)

    def config(self, method: str, sequence: str, budget: int | None, seed: int) -> Any:
        """The full options of one cell: a `Config`, or the dataclass of a method that has options of its own.

        Raises:
            InputError: an override names no field, or has a value of the wrong kind.
        """
        chosen, has_config = self.methods[method], self.has_config(method)
        options = REGISTRY.load(chosen.name).options
        values = to_dict(options)
        for where, overrides in (
            ("set", self.set if has_config else {}),
            (f"set_for.{chosen.name}", self.set_for.get(chosen.name, {})),
            (f"methods.{method}.set", chosen.set),
        ):
            override(values, overrides, where)
        if has_config:
            values["data"] |= self.sequences[sequence].reading
            if budget is not None:
                values["init"]["budget"] = budget
            values["seed"] = seed
        if chosen.pictures:
            folders = {"folder": chosen.pictures, "depth_folder": chosen.depth_pictures}
            values |= {name: self._folder(paths.get(sequence, ""), seed) for name, paths in folders.items()}
            values |= {"depth_scale": chosen.depth_scale, "name": self.label(method)}
        return from_dict(type(options), values, f"methods.{method}")

    def _folder(self, path: str, seed: int) -> str:
        """A folder of images; empty if there is none."""
        return str(self.resolved(path.replace("{seed}", str(seed))).absolute()) if path else ""

    def resolved(self, path: str) -> Path:
        """A path of the spec: `~` and `$NAME` expanded, relative to the spec's folder."""
        expanded = Path(os.path.expandvars(path)).expanduser()
        return expanded if expanded.is_absolute() else Path(self.folder) / expanded


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
                raise InputError(f"--data {name}: expected one of {', '.join(spec.sequences)}. Fix: Correct the name.")
            known = replace(spec.sequences[name], path=str(folder.absolute()), phantom=None)
            spec = replace(spec, sequences=spec.sequences | {name: known})
        _check(spec)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return spec


def load_specs(paths: list[Path], data: dict[str, Path]) -> dict[Path, Spec]:
    """Read and check specs, each with the folders in `data` of its own sequences.

    Raises:
        InputError: as `load_spec`; also for a name in `data` that is a sequence of none of them.
    """
    specs = {path: load_spec(path) for path in paths}
    known = {name for spec in specs.values() for name in spec.sequences}
    for path, spec in specs.items():
        if own := {name: data[name] for name in data if name in spec.sequences or name not in known}:
            specs[path] = load_spec(path, own)
    return specs


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
        raise InputError(f"{path}: expected a file that does not extend itself. Fix: Remove one `extends`.")
    if len(chain) >= MOST_EXTENDED:
        raise InputError(f"{path}: expected at most {MOST_EXTENDED} files that extend each other. Fix: Merge some.")
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
        if len({name.lower() for name in names}) < len(names):  # figures have these names
            raise input_error(kind, "names that differ in more than case", ", ".join(names), "rename one.")
    for name, sequence in spec.sequences.items():
        if bool(sequence.path) == (sequence.phantom is not None):
            raise input_error(f"sequences.{name}", "either path or phantom", "both or none", "keep one.")
        if sequence.phantom and (sequence.shrink > 1 or sequence.first_frames):
            raise InputError(f"sequences.{name}: a phantom has its own size. Fix: Remove shrink and first_frames.")
        if sequence.format != "auto" and sequence.format not in LAYOUTS.names():
            want = f"auto, {', '.join(LAYOUTS.names())}"
            raise input_error(f"sequences.{name}.format", want, repr(sequence.format), "see docs/datasets.md.")
    known = [name for name in REGISTRY.names() if name != PICTURES]
    for name in spec.set_for:
        if name not in known:
            raise input_error("set_for", f"one of {', '.join(known)}", f"{name!r}", "choose one.")
    for name, method in spec.methods.items():
        _check_method(spec, f"methods.{name}", method, known)
    named = [spec.reference, *(name for claim in spec.claims for name in (claim.method, claim.than))]
    for name in named:
        if name not in spec.methods:
            raise input_error("claims, compare_with", f"one of {', '.join(spec.methods)}", f"{name!r}", "correct it.")
    for name in (*spec.scores, *(claim.score for claim in spec.claims)):
        if name not in all_scores():
            raise input_error("scores, claims", "names of scores", f"{name!r}", "see docs/scores.md.")
    if len(set(spec.protocols)) < len(spec.protocols):
        raise input_error("protocols", "different names", ", ".join(spec.protocols), "remove one.")
    if not spec.seeds or len(set(spec.seeds)) < len(spec.seeds):
        raise input_error("seeds", "different numbers", f"{list(spec.seeds)}", "correct them.")
    count = len(spec.seeds) * len(spec.sequences) * max(len(spec.budgets), 1) * len(spec.methods)
    if count > MOST_CELLS:
        raise input_error("methods x sequences x budgets x seeds", f"at most {MOST_CELLS}", f"{count}", "split.")
    for cell in cells(spec):
        options = spec.config(cell.method, cell.sequence, cell.budget, cell.seed)
        found, where = spec.sequences[cell.sequence].found_parts, f"sequences.{cell.sequence}"
        if "masks" in found and spec.has_config(cell.method) and options.data.use_gt_masks:
            raise input_error(f"{where}.masks", "either found or gt_masks", "both", "remove data.use_gt_masks.")
        if "poses" in found and spec.has_config(cell.method) and options.data.depth_unit_mm:
            fix = "write the unit to sequence.json as depth_scale."
            raise input_error(f"{where}.poses", "either estimated or data.depth_unit_mm", "both", fix)


def _check_method(spec: Spec, where: str, method: MethodSpec, known: list[str]) -> None:
    if bool(method.preset) + bool(method.method) + bool(method.pictures) > 1:
        raise input_error(where, "one of preset, method and pictures", "several", "keep one.")
    for key, name, choice in (("preset", method.preset, PresetName.__args__), ("method", method.method, known)):
        if name and name not in choice:
            raise input_error(f"{where}.{key}", f"one of {', '.join(choice)}", f"{name!r}", "choose one.")
    if not method.pictures and (method.depth_pictures or method.depth_scale):
        raise input_error(where, "depth_pictures and depth_scale beside pictures", "no pictures", "add pictures.")
    for key, folders in (("pictures", method.pictures), ("depth_pictures", method.depth_pictures)):
        for name, path in folders.items():
            if name not in spec.sequences:
                choice = ", ".join(spec.sequences)
                raise input_error(f"{where}.{key}", f"one of {choice}", f"{name!r}", "correct the name.")
            if not path:
                raise input_error(f"{where}.{key}.{name}", "a folder", "nothing", "name it or remove the entry.")


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
        for method, about in spec.methods.items()
        if seed == spec.seeds[0] or about.differs_by_seed(sequence)
    ]


def sequence_folder(spec: Spec, name: str, out: Path) -> Path:
    """Folder of a sequence: the user's, or the phantom's below `out`."""
    sequence = spec.sequences[name]
    if sequence.phantom:
        fields = json.dumps(to_dict(sequence.phantom), sort_keys=True)
        return out / "sequences" / f"phantom-{hashlib.sha256(fields.encode()).hexdigest()[:8]}"
    return spec.resolved(sequence.path)
