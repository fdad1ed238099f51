"""`endoprior bench SPEC OUT`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from endoprior.cli.arguments import Command, parse
from endoprior.core.checks import input_error
from endoprior.system.console import say
from endoprior.system.devices import num_cores

from .tool_training import bench as bench_masks

if TYPE_CHECKING:
    from .spec import Spec

MAX_CORES = 4096
"""Largest --cores and --threads."""
MAX_ITERATIONS = 10_000_000


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
        return bench_masks.run(argv[1:])
    if page := _page(argv):
        say(page)
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
    from .spec_page import spec_page

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
