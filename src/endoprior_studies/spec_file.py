"""Find a spec by name or path, read it from YAML or TOML, and check it completely before anything runs."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from endoprior.core.checks import InputError, input_error, or_did_you_mean
from endoprior.core.config_io import from_dict
from endoprior.data.formats import REGISTRY as LAYOUTS
from endoprior.data.reading import load_yaml, read_text
from endoprior.data.sequence import TEST_EVERY
from endoprior.evaluation.protocols.table import PROTOCOLS
from endoprior.evaluation.registry import all_scores
from endoprior.model.presets import preset_names

from .method import PICTURES, method_names
from .spec import MatchSpec, MethodSpec, SequenceSpec, Spec, SpecSelection, cells

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
"""Names of methods and sequences become folders."""
MAX_EXTENDED = 8
FOLDER = Path(__file__).parent / "specs"
"""Specs that come with the program. `endoprior bench` takes them by name: `quick`, `sized`, `sized/growth`."""
MISSING = "install the package with this plugin; `endoprior plugins` lists what is installed."
"""What to do about a name that no installed package has."""
READERS: dict[str, Callable[[str], Any]] = {".yaml": load_yaml, ".yml": load_yaml, ".toml": tomllib.loads}
MAX_CELLS = 100_000


def spec_names() -> list[str]:
    """Names of the specs, and of the folders of specs, that come with the program."""
    files = [path.relative_to(FOLDER).with_suffix("") for path in _specs(FOLDER, "**/*")]
    folders = {path.parent for path in files} - {Path()}
    return sorted(path.as_posix() for path in {*files, *folders})


def find_spec(name_or_path: str) -> Path:
    """The file or folder of a name or path.

    Args:
        name_or_path: a name wins over a path: with a folder `quick` of your own, write `./quick`.
    Raises:
        InputError: neither a name nor a path that exists.
    """
    names = spec_names()
    if name_or_path in names:
        folder = FOLDER / name_or_path
        return folder if folder.is_dir() else folder.with_suffix(".yaml")
    if not Path(name_or_path).exists():
        fix = or_did_you_mean("correct SPEC.", name_or_path, names)
        raise input_error(name_or_path, f"a file, a folder or one of {', '.join(names)}", "neither", fix)
    return Path(name_or_path)


def specs_of(path: Path) -> list[Path]:
    """The spec itself, or those of a folder, sorted by name.

    Raises:
        InputError: the folder holds no specs.
    """
    if not path.is_dir():
        return [path]
    if specs := _specs(path, "*"):
        return specs
    raise input_error(path, ".yaml or .toml files", "none", "Pass a folder of specs.")


def _specs(folder: Path, pattern: str) -> list[Path]:
    """Spec files. One that starts with `_` is only there to be extended."""
    return sorted(path for path in folder.glob(pattern) if path.suffix in READERS and path.name[0] != "_")


def load_spec(path: Path, data: dict[str, Path] | None = None, selection: SpecSelection | None = None) -> Spec:
    """Read and check a spec.

    Args:
        path: `.yaml`, `.yml` or `.toml`.
        data: folders of sequences by name; they override those of the file.
        selection: the part of it to run; None is everything.
    Raises:
        InputError: naming the file, the field, what is expected and what is there.
    """
    values = _read(path)
    try:
        for name in ("title", "sequences", "methods"):
            if not values.get(name):
                raise input_error(name, "an entry", "none", "add it.")
        if isinstance(claims := values.get("claims"), list):
            values["claims"] = [one for place, claim in enumerate(claims) for one in _single_claims(claim, place)]
        spec = replace(from_dict(Spec, values, "spec"), folder=str(path.parent))
        for name, folder in (data or {}).items():
            if name not in spec.sequences:
                raise InputError(f"--data {name}: expected one of {', '.join(spec.sequences)}. Fix: Correct the name.")
            known = replace(spec.sequences[name], path=str(folder.absolute()), phantom=None)
            spec = replace(spec, sequences=spec.sequences | {name: known})
        spec = selection.of(spec) if selection else spec
        _check(spec)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return spec


def load_specs(paths: list[Path], data: dict[str, Path], selection: SpecSelection | None = None) -> dict[Path, Spec]:
    """Read and check specs, each with the folders in `data` of its own sequences; without those it leaves empty.

    Raises:
        InputError: as `load_spec`; also for a name in `data` or `selection` that is in none of them.
    """
    specs, selection = {path: load_spec(path) for path in paths}, selection or SpecSelection()
    known = {name for spec in specs.values() for name in spec.sequences}
    methods = sorted({name for spec in specs.values() for name in spec.methods})
    for name in selection.methods:
        _demand_one_of("--methods", name, methods)
    chosen = {}
    for path, spec in specs.items():
        own = {name: data[name] for name in data if name in spec.sequences or name not in known}
        if not selection.methods or {*selection.methods} & {*spec.methods}:
            chosen[path] = load_spec(path, own, selection)
    return chosen


def _read(path: Path, chain: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Entries of a file and the files it `extends`: later ones override, `set` and `set_for` are merged.

    Raises:
        InputError: a file cannot be read, or extends itself.
    """
    if path.suffix not in READERS:
        raise input_error(path, "a .yaml or .toml file", f"{path.suffix or 'no suffix'}", "rename it.")
    text = read_text(path, "a readable file", "Correct the path.")
    if path.resolve() in chain:
        raise InputError(f"{path}: expected a file that does not extend itself. Fix: Remove one `extends`.")
    if len(chain) >= MAX_EXTENDED:
        raise InputError(f"{path}: expected at most {MAX_EXTENDED} files that extend each other. Fix: Merge some.")
    try:
        values = READERS[path.suffix](text)
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


def _single_claims(claim: Any, place: int) -> list[Any]:
    """A claim for each of its scores and each method that it is compared with: `score` and `than` may be lists."""
    if not isinstance(claim, dict):
        return [claim]
    lists = {key: claim[key] for key in ("score", "than") if isinstance(claim.get(key), list)}
    for key, names in lists.items():
        if not names:
            raise input_error(f"claims.{place}.{key}", "a name or a list of names", "an empty list", "add one.")
    return [claim | dict(zip(lists, chosen, strict=True)) for chosen in product(*lists.values())]


def _demand(sound: object, where: str, expected: str, got: str, fix: str) -> None:
    if not sound:
        raise input_error(where, expected, got, fix)


def _demand_one_of(where: str, name: str, choice: Iterable[str], fix: str = "choose one.") -> None:
    known = [*choice]
    fix = or_did_you_mean(fix, name, known)
    _demand(name in known, where, f"one of {', '.join(known) or 'none'}", f"{name!r}", fix)


def _demand_plugin(where: str, name: str, installed: Sequence[str]) -> None:
    """As `_demand_one_of`, for names that packages add: one is misspelled, or its package is missing."""
    got = f"{name!r}, which no installed package has"
    fix = or_did_you_mean(MISSING, name, installed)
    _demand(name in installed, where, f"one of {', '.join(installed)}", got, fix)


def _check(spec: Spec) -> None:
    _check_names(spec)
    for name, sequence in spec.sequences.items():
        _check_sequence(f"sequences.{name}", sequence)
    known = [name for name in method_names() if name != PICTURES]
    for name in spec.set_for:
        _demand_one_of("set_for", name, known)
    for name, method in spec.methods.items():
        _check_method(spec, f"methods.{name}", method, known)
    for name, method in spec.methods.items():
        if method.match:
            _check_match(spec, name, method.match)
    for name in (spec.reference, *(name for claim in spec.claims for name in (claim.method, claim.than))):
        _demand_one_of("claims, compare_with", name, spec.methods)
    for name in (*spec.scores, *(claim.score for claim in spec.claims)):
        fix = f"see docs/scores.md, or {MISSING}"
        _demand(name in all_scores(), "scores, claims", "names of scores", f"{name!r}", fix)
    for name in spec.protocols:
        _demand_plugin("protocols", name, PROTOCOLS.names())
    _check_cells(spec)


def _check_names(spec: Spec) -> None:
    for kind, names in (("sequences", spec.sequences), ("methods", spec.methods)):
        for name in names:
            _demand(NAME.fullmatch(name), kind, "a name of letters, digits and . _ + -", f"{name!r}", "rename it.")
        differ = len({name.lower() for name in names}) == len(names)  # figures have these names
        _demand(differ, kind, "names that differ in more than case", ", ".join(names), "rename one.")
    for where, what, values in (("protocols", "names", spec.protocols), ("seeds", "numbers", spec.seeds)):
        _demand(len(set(values)) == len(values), where, f"different {what}", f"{[*values]}", "correct them.")
    _demand(spec.seeds, "seeds", "different numbers", "none", "add one.")
    _demand(spec.iterations >= 0, "iterations", "a number of at least 0", f"{spec.iterations}", "correct it.")


def _check_cells(spec: Spec) -> None:
    folds = sum(len(sequence.folds) for sequence in spec.sequences.values())
    count = len(spec.seeds) * folds * max(len(spec.budgets), 1) * len(spec.methods)
    where = "methods x sequences x budgets x seeds"
    _demand(count <= MAX_CELLS, where, f"at most {MAX_CELLS}", f"{count}", "split.")
    for cell in cells(spec):
        options = spec.config(cell.method, cell.sequence, cell.budget, cell.seed, fold=cell.fold)
        if not spec.has_config(cell.method):
            continue
        found, where = spec.sequences[cell.sequence].found_parts, f"sequences.{cell.sequence}"
        if "masks" in found and options.data.use_gt_masks:
            raise input_error(f"{where}.masks", "either found or gt_masks", "both", "remove data.use_gt_masks.")
        if "poses" in found and options.data.depth_unit_mm:
            fix = "write the unit to sequence.json as depth_scale."
            raise input_error(f"{where}.poses", "either estimated or data.depth_unit_mm", "both", fix)


def _check_sequence(where: str, sequence: SequenceSpec) -> None:
    has_one = bool(sequence.path) != (sequence.phantom is not None)
    _demand(has_one, where, "either path or phantom", "both or none", "keep one.")
    if sequence.phantom and (sequence.shrink > 1 or sequence.first_frames):
        raise InputError(f"{where}: a phantom has its own size. Fix: Remove shrink and first_frames.")
    known = ("auto", *LAYOUTS.names())
    _demand(
        sequence.format in known, f"{where}.format", ", ".join(known), repr(sequence.format), "see docs/datasets.md."
    )
    folds = {fold for fold in sequence.folds if 0 <= fold < TEST_EVERY}
    want = f"different numbers from 0 to {TEST_EVERY - 1}"
    sound = folds and len(folds) == len(sequence.folds)
    _demand(sound, f"{where}.folds", want, f"{[*sequence.folds]}", "correct them.")


def _check_match(spec: Spec, name: str, match: MatchSpec) -> None:
    where, methods = f"methods.{name}.match", spec.methods
    given = [bool(match.count_of), match.growth != 0, bool(match.value_of)]
    _demand(given.count(True) == 1, where, "one of count_of, growth and value_of", "none or several", "keep one.")
    _demand(spec.has_config(name), where, "a method with our config", methods[name].name, "remove match.")
    _demand(match.growth >= 0, f"{where}.growth", "a number above 0", f"{match.growth}", "correct it.")
    if match.count_of:
        _demand_one_of(f"{where}.count_of", match.count_of, (n for n, about in methods.items() if not about.match))
    if match.value_of:
        searched = (n for n, about in methods.items() if about.match and not about.match.value_of)
        _demand_one_of(f"{where}.value_of", match.value_of, searched)


def _check_method(spec: Spec, where: str, method: MethodSpec, known: list[str]) -> None:
    kinds = [method.preset, method.method, method.pictures]
    _demand(sum(map(bool, kinds)) <= 1, where, "one of preset, method and pictures", "several", "keep one.")
    for key, name, choice in (("preset", method.preset, preset_names()), ("method", method.method, known)):
        if name:
            _demand_plugin(f"{where}.{key}", name, choice)
    alone = not method.pictures and (method.depth_pictures or method.depth_scale)
    _demand(not alone, where, "depth_pictures and depth_scale beside pictures", "no pictures", "add pictures.")
    for key, folders in (("pictures", method.pictures), ("depth_pictures", method.depth_pictures)):
        for name, path in folders.items():
            _demand_one_of(f"{where}.{key}", name, spec.sequences)
            _demand(path, f"{where}.{key}.{name}", "a folder", "nothing", "name it or remove the entry.")
