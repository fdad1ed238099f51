"""`endoprior bench SPEC OUT`, `endoprior bench masks OUT`, and the help page of a spec: `bench SPEC --help`."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

from endoprior.cli.arguments import Command, parse
from endoprior.core.checks import input_error
from endoprior.system.console import say
from endoprior.system.devices import num_cores
from endoprior.system.installation import page

if TYPE_CHECKING:
    from .spec import SequenceSpec, Spec

MAX_CORES = 4096
"""Largest --cores and --threads."""
MAX_ITERATIONS = 10_000_000
DATA_ROOT = "$ENDOPRIOR_DATA/"
"""Paths of sequences that a user has to have begin with it."""
PAGE_WIDTH = 80


@dataclass
class Bench(Command):
    """Compare methods on sequences over seeds, under one protocol. Finished cells in OUT are kept."""

    spec: str = field(metadata={"place": "SPEC"})
    """A .yaml or .toml file, a folder of them, or a name. quick: minutes. masks: the network that finds tools
    (`endoprior bench masks --help`). found_masks: given and found tool masks. poses: given and estimated camera path.
    reproduce: the paper's tables on EndoNeRF data and SCARED, published figures beside yours; one table: reproduce/NAME
    with table1, table1_scared, table2, table3, table4, table5. sized: tables for two cores; one: sized/NAME with
    budgets, compared, depth_flags, growth, instability, ladder, matched, methods, primitives, regime, temporal. full:
    most at full size. whole: each as released and fitted; clip, phantom: full size; kinds, parts: small frames;
    own: your clip; mechanics: laws of motion. radiance: radiance fields."""
    out: Path = field(metadata={"place": "OUT"})
    """Folder for cells and reports; equal cells of several specs are run once."""
    cores: int = 0
    """Cores to use in total; 0 uses all of this machine."""
    threads: int = 1
    """Cores of each cell. One is most efficient; more finish a single cell sooner."""
    ray: str | None = None
    """Address of a Ray cluster that shares this file system; `local` starts one."""
    data: tuple[str, ...] = ()
    """NAME=FOLDER: the folder of a sequence of the spec, in place of the spec's own."""
    methods: tuple[str, ...] = ()
    """Only these methods of the spec."""
    seeds: tuple[int, ...] = ()
    """Seeds, in place of those of the spec."""
    iterations: int = 0
    """Length of every training, in place of the method's own: a trial of the whole way, not a result."""
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    report_only: bool = False
    """Train nothing; write the report of the finished cells."""
    estimate: bool = False
    """Only measure how long it will take. reproduce does so before it begins."""

    examples = (
        "quick OUT",
        "sized OUT --report-only",
        "reproduce OUT --data pulling=FOLDER cutting=FOLDER d1=FOLDER --estimate",
    )


def run(argv: list[str]) -> int:
    """Run the matrix and write its report; 1 if a cell failed."""
    if argv[:1] == ["masks"]:
        return run_masks(argv[1:])
    if words := _page(argv):
        say(words)
        return 0
    args = parse(Bench, argv, "bench")
    from endoprior.cli.paths import require_writable_folder
    from endoprior.system.file_lock import locked

    from .execute import local_executor, ray_executor
    from .matrix import Matrix, run_matrix
    from .report import write_overview, write_report
    from .spec_file import find_spec
    from .timing import estimate

    folders = _checked(args)
    source = find_spec(args.spec)
    loaded = _chosen(args, source, folders)
    require_writable_folder("OUT", args.out)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise input_error(args.out, "a place for a folder", f"{error.strerror}", "Choose another folder.") from None
    at_once, reports = 1 if args.ray else max(1, (args.cores or num_cores()) // args.threads), {}
    with locked(args.out, args.out / ".lock"):
        if args.report_only:
            executor = nullcontext(None)
        elif args.ray:
            executor = ray_executor(args.ray, args.threads)
        else:
            executor = local_executor(at_once)
        with executor as execute:

            def matrix_of(spec: Spec) -> Matrix:
                about = {"threads": args.threads, "weights_dir": args.weights_dir}
                return run_matrix(spec, args.out, execute, **about, progress=say)

            if execute and (args.estimate or any(spec.published for spec in loaded.values())):
                say("estimate: each method with a long schedule is first trained for a short time")
                named = {path.stem: spec for path, spec in loaded.items()}
                say("\n".join(estimate(named, args.out, matrix_of).lines(at_once)))
            for path, spec in () if args.estimate else loaded.items():
                folder = args.out / path.stem if source.is_dir() else args.out
                say(f"{path}: {spec.title}")
                matrix = reports[folder] = matrix_of(spec)
                report = write_report(matrix, folder)
                say(f"{len(matrix.done)} cells done, {len(matrix.missing)} without a result\nreport: {report}")
    if source.is_dir() and reports:
        say(f"overview: {write_overview(reports, args.out)}")
    return 1 if any(matrix.failed for matrix in reports.values()) else 0


def _page(argv: list[str]) -> str:
    """The help page of the spec that is named before `--help`; empty if none is."""
    first, *rest = argv or [""]
    if first.startswith("-") or not {"-h", "--help"} & {*rest}:
        return ""
    from .spec_file import find_spec

    return spec_page(first, find_spec(first))


def _checked(args: Bench) -> dict[str, Path]:
    """The folders of `--data` by the name of their sequence; InputError if an option has an impossible value."""
    limits = (("--threads", args.threads, 1, MAX_CORES), ("--cores", args.cores, 0, MAX_CORES))
    for option, value, least, most in (*limits, ("--iterations", args.iterations, 0, MAX_ITERATIONS)):
        if not least <= value <= most:
            raise input_error(option, f"{least} to {most}", f"{value}", "choose a value in this range.")
    if args.weights_dir and not args.weights_dir.is_dir():
        raise input_error(args.weights_dir, "a folder with weights", "none", "Correct --weights-dir.")
    folders = {}
    for item in args.data:
        name, separator, folder = item.partition("=")
        if not separator or not folder:
            raise input_error("--data", "NAME=FOLDER", f"{item!r}", "Name a sequence of the spec.")
        folders[name] = Path(folder).expanduser()
    return folders


def _chosen(args: Bench, source: Path, folders: dict[str, Path]) -> dict[Path, Spec]:
    """The specs to run. Folders that were typed must be there; of published tables those run that they belong to."""
    from .matrix import open_sequence
    from .spec import SpecSelection
    from .spec_file import load_specs, specs_of

    loaded = load_specs(specs_of(source), folders, SpecSelection(args.methods, args.seeds, args.iterations))
    typed = {path: folders.keys() & spec.sequences.keys() for path, spec in loaded.items()}
    for path, names in typed.items():
        for name in sorted(names):
            open_sequence(loaded[path], name, args.out, write=False)
    return {path: spec for path, spec in loaded.items() if typed[path] or not (folders and spec.published)}


def spec_page(name: str, source: Path) -> str:
    """What the spec of a name, or the specs of its folder, need and take. Args: source: its file or folder."""
    from .spec_file import load_spec, specs_of

    specs = {path: load_spec(path) for path in specs_of(source)}
    own: dict[str, str] = {}
    for spec in specs.values():
        own = {data: _words(spec, data) for data, each in spec.sequences.items() if each.path} | own
    methods = sorted({method for spec in specs.values() for method in spec.methods})
    lines = [f"usage: endoprior bench {name} OUT{' [--data NAME=FOLDER ...]' if own else ''} [options]", ""]
    width = max(len(path.stem) for path in specs)
    for path, spec in specs.items():
        lines += _wrapped(f"  {name}/{path.stem:<{width}}  " if source.is_dir() else "", spec.title)
    if own:
        lines += ["", "names for --data; those that you leave out are looked for in $ENDOPRIOR_DATA:"]
        width = max(map(len, own))
        for data, words in own.items():
            lines += _wrapped(f"  {data:<{width}}  ", words)
    lines += ["", *_wrapped("names for --methods: ", ", ".join(methods))]
    given = " ".join(["--data", *(f"{data}=FOLDER" for data in list(own)[:2])]) if own else "--estimate"
    lines += ["", f"All options: `endoprior bench --help`. The page: {page('benchmarks.md')}"]
    lines += ["", "examples:", f"  endoprior bench {name} OUT {given}"]
    if own:
        lines.append(f"  endoprior bench {name} OUT {given} --estimate")
    return "\n".join(lines)


def _words(spec: Spec, name: str) -> str:
    """What the folder of a sequence is: the data it belongs to, its place there, layout and frames."""
    sequence, about = spec.sequences[name], spec.published
    parts = [f"{about.data}: {_place(sequence)}" if about else _place(sequence)]
    if about and name in about.frames:
        parts.append(f"{about.frames[name]} frames")
    if sequence.format == "scared":
        parts.append("the folder that holds data/")
    elif sequence.format != "auto":
        parts.append(f"layout {sequence.format}")
    if sequence.stride > 1:
        parts.append(f"1 frame of {sequence.stride} is used")
    return ", ".join(parts)


def _place(sequence: SequenceSpec) -> str:
    """The folder as its dataset calls it."""
    known = sequence.path.removeprefix(DATA_ROOT)
    return known.partition("/")[2] or f"a sequence folder, {sequence.path}"


def _wrapped(head: str, words: str) -> list[str]:
    return wrap(words, PAGE_WIDTH, initial_indent=head, subsequent_indent=" " * (len(head) or 2))


@dataclass
class BenchMasks(Command):
    """Train the network that finds tools without each set of real frames, and score it on that set.

    A network takes hours. Networks in OUT are kept, and an interrupted training resumes. The clips are read from
    the folder that the environment variable ENDOPRIOR_DATA names.
    """

    out: Path = field(metadata={"place": "OUT"})
    """Folder for networks, phantoms and the report."""
    steps: int = 8000
    """Training steps of each network, of 16 images each."""
    seed: int = 0
    """Seed of weights and examples."""
    pretrained: Path | None = None
    """Weights of EfficientNet-Lite0 that each network starts from (docs/tool_network.md); random without them."""
    write_weights: Path | None = None
    """Also write the weights of the network that was trained with all sets to this file."""

    examples = ("OUT", "OUT --steps 500")


def run_masks(argv: list[str]) -> int:
    """Train and score the networks, and write the report."""
    args = parse(BenchMasks, argv, "bench masks")
    if not 1 <= args.steps <= 10**6:
        raise input_error("--steps", "1 to 1000000", f"{args.steps}", "Choose a value in this range.")
    root = Path(os.environ.get("ENDOPRIOR_DATA", ""))
    if not (root / "vocalfolds").is_dir():
        fix = "ENDOPRIOR_DATA=FOLDER with bowel_lift/, vocalfolds/, mono_endo.mp4 and wild/ (docs/tool_network.md)."
        raise input_error("ENDOPRIOR_DATA", "the folder of the clips", repr(str(root)), f"Set {fix}")
    from endoprior.cli.paths import require_writable_folder
    from endoprior.system.file_lock import locked

    from .tool_training.fit import pretrained
    from .tool_training.leave_one_out import ALL, Training, rows, weights_file, write_report

    require_writable_folder("OUT", args.out)
    start = pretrained(args.pretrained, args.seed) if args.pretrained else None
    args.out.mkdir(parents=True, exist_ok=True)
    with locked(args.out, args.out / ".lock"):
        table = []
        for row in rows(args.out, root, Training(args.steps, args.seed, start), say):
            say(f"{row.name}: {', '.join(f'{k} {v:.3f}' for k, v in row.score.total.scores().items())}")
            table.append(row)
        settings = {
            "steps": args.steps,
            "seed": args.seed,
            "pretrained": args.pretrained.name if args.pretrained else "no",
        }
        report = write_report(args.out, table, settings)
        if args.write_weights:
            args.write_weights.write_bytes(weights_file(args.out, ALL).read_bytes())
    say(f"report: {report}")
    return 0
