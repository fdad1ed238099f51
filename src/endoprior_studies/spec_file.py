"""Read a spec from a YAML or TOML file, and check it completely before anything runs."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from endoprior.core.checks import InputError, input_error
from endoprior.core.config_io import from_dict
from endoprior.data.formats import REGISTRY as LAYOUTS
from endoprior.data.reading import load_yaml, read_text
from endoprior.data.sequence import TEST_EVERY
from endoprior.evaluation.protocols.table import PROTOCOLS
from endoprior.evaluation.registry import all_scores
from endoprior.model.presets import preset_names

from .method import PICTURES, method_names
from .spec import MatchSpec, MethodSpec, Spec, cells

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
"""Names of methods and sequences become folders."""
MOST_EXTENDED = 8
MOST_CELLS = 100_000


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
        if isinstance(claims := values.get("claims"), list):
            values["claims"] = [one for place, claim in enumerate(claims) for one in _single_claims(claim, place)]
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


def _single_claims(claim: Any, place: int) -> list[Any]:
    """A claim for each of its scores and each method that it is compared with: `score` and `than` may be lists."""
    if not isinstance(claim, dict):
        return [claim]
    lists = {key: claim[key] for key in ("score", "than") if isinstance(claim.get(key), list)}
    for key, names in lists.items():
        if not names:
            raise input_error(f"claims.{place}.{key}", "a name or a list of names", "an empty list", "add one.")
    return [claim | dict(zip(lists, chosen, strict=True)) for chosen in product(*lists.values())]


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
        folds = {fold for fold in sequence.folds if 0 <= fold < TEST_EVERY}
        if not folds or len(folds) < len(sequence.folds):
            want = f"different numbers from 0 to {TEST_EVERY - 1}"
            raise input_error(f"sequences.{name}.folds", want, f"{list(sequence.folds)}", "correct them.")
    known = [name for name in method_names() if name != PICTURES]
    for name in spec.set_for:
        if name not in known:
            raise input_error("set_for", f"one of {', '.join(known)}", f"{name!r}", "choose one.")
    for name, method in spec.methods.items():
        _check_method(spec, f"methods.{name}", method, known)
    for name, method in spec.methods.items():
        if method.match:
            _check_match(spec, name, method.match)
    named = [spec.reference, *(name for claim in spec.claims for name in (claim.method, claim.than))]
    for name in named:
        if name not in spec.methods:
            raise input_error("claims, compare_with", f"one of {', '.join(spec.methods)}", f"{name!r}", "correct it.")
    for name in (*spec.scores, *(claim.score for claim in spec.claims)):
        if name not in all_scores():
            raise input_error("scores, claims", "names of scores", f"{name!r}", "see docs/scores.md.")
    for name in spec.protocols:
        if name not in (known := PROTOCOLS.names()):
            raise input_error("protocols", f"one of {', '.join(known)}", f"{name!r}", "choose one.")
    if len(set(spec.protocols)) < len(spec.protocols):
        raise input_error("protocols", "different names", ", ".join(spec.protocols), "remove one.")
    if not spec.seeds or len(set(spec.seeds)) < len(spec.seeds):
        raise input_error("seeds", "different numbers", f"{list(spec.seeds)}", "correct them.")
    folds = sum(len(sequence.folds) for sequence in spec.sequences.values())
    count = len(spec.seeds) * folds * max(len(spec.budgets), 1) * len(spec.methods)
    if count > MOST_CELLS:
        raise input_error("methods x sequences x budgets x seeds", f"at most {MOST_CELLS}", f"{count}", "split.")
    for cell in cells(spec):
        options = spec.config(cell.method, cell.sequence, cell.budget, cell.seed, fold=cell.fold)
        found, where = spec.sequences[cell.sequence].found_parts, f"sequences.{cell.sequence}"
        if "masks" in found and spec.has_config(cell.method) and options.data.use_gt_masks:
            raise input_error(f"{where}.masks", "either found or gt_masks", "both", "remove data.use_gt_masks.")
        if "poses" in found and spec.has_config(cell.method) and options.data.depth_unit_mm:
            fix = "write the unit to sequence.json as depth_scale."
            raise input_error(f"{where}.poses", "either estimated or data.depth_unit_mm", "both", fix)


def _check_match(spec: Spec, name: str, match: MatchSpec) -> None:
    where = f"methods.{name}.match"
    if [bool(match.count_of), match.growth != 0, bool(match.value_of)].count(True) != 1:
        raise input_error(where, "one of count_of, growth and value_of", "none or several", "keep one.")
    if not spec.has_config(name):
        raise input_error(where, "a method with our config", spec.methods[name].name, "remove match.")
    if match.growth and not match.growth > 0:
        raise input_error(f"{where}.growth", "a number above 0", f"{match.growth}", "correct it.")
    if match.count_of and (match.count_of not in spec.methods or spec.methods[match.count_of].match):
        choice = ", ".join(other for other, about in spec.methods.items() if not about.match)
        raise input_error(f"{where}.count_of", f"one of {choice}", repr(match.count_of), "choose one.")
    searched = [n for n, about in spec.methods.items() if about.match and not about.match.value_of]
    if match.value_of and match.value_of not in searched:
        choice = f"one of {', '.join(searched)}" if searched else "a method with a search"
        raise input_error(f"{where}.value_of", choice, repr(match.value_of), "choose one.")


def _check_method(spec: Spec, where: str, method: MethodSpec, known: list[str]) -> None:
    if bool(method.preset) + bool(method.method) + bool(method.pictures) > 1:
        raise input_error(where, "one of preset, method and pictures", "several", "keep one.")
    for key, name, choice in (("preset", method.preset, preset_names()), ("method", method.method, known)):
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
