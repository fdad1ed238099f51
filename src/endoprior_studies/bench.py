"""`endoprior bench SPEC OUT`."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from endoprior.cli.arguments import Command, parse
from endoprior.core.checks import input_error
from endoprior.system.console import say

from .tool_training import bench as bench_masks

MOST_CORES = 4096
"""Largest --cores and --threads."""


@dataclass
class Bench(Command):
    """Compare methods on sequences over seeds, under one protocol. Finished cells in OUT are kept."""

    spec: str = field(metadata={"place": "SPEC"})
    """A .yaml or .toml file, a folder of them, or a name. quick: minutes. masks: the network that finds tools, on
    frames that it has not seen (`endoprior bench masks --help`). found_masks: given and found tool masks. poses: given
    and estimated camera path. sized: the paper's tables, for two cores. full: the same at full size.
    radiance: the two radiance fields, a day. One table: sized/NAME or full/NAME with budgets, compared, depth_flags,
    growth, instability, ladder, matched, methods, primitives, regime, temporal; sized/whole_phantom; sized/whole_clip;
    full/radiance; full/scared."""
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
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    report_only: bool = False
    """Train nothing; write the report of the finished cells."""

    examples = ("quick OUT", "sized OUT --report-only")


def run(argv: list[str]) -> int:
    """Run the matrix and write its report; 1 if a cell failed."""
    if argv[:1] == ["masks"]:
        return bench_masks.run(argv[1:])
    args = parse(Bench, argv, "bench")
    from endoprior.cli.paths import require_writable_folder
    from endoprior.system.file_lock import locked

    from .execute import local_executor, ray_executor
    from .matrix import run_matrix
    from .report import write_overview, write_report
    from .spec_file import find_spec, load_specs, specs_of

    for option, value, least in (("--threads", args.threads, 1), ("--cores", args.cores, 0)):
        if not least <= value <= MOST_CORES:
            raise input_error(option, f"{least} to {MOST_CORES}", f"{value}", "choose a value in this range.")
    if args.weights_dir and not args.weights_dir.is_dir():
        raise input_error(args.weights_dir, "a folder with weights", "none", "Correct --weights-dir.")
    folders, source = _folders(args.data), find_spec(args.spec)
    loaded = load_specs(specs_of(source), folders)
    require_writable_folder("OUT", args.out)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise input_error(args.out, "a place for a folder", f"{error.strerror}", "Choose another folder.") from None
    failed, reports = 0, {}
    with locked(args.out, args.out / ".lock"):
        if args.report_only:
            executor = nullcontext(None)
        elif args.ray:
            executor = ray_executor(args.ray, args.threads)
        else:
            executor = local_executor(max(1, (args.cores or _cores()) // args.threads))
        with executor as execute:
            for path, spec in loaded.items():
                folder = args.out / path.stem if source.is_dir() else args.out
                say(f"{path}: {spec.title}")
                matrix = run_matrix(
                    spec, args.out, execute, threads=args.threads, weights_dir=args.weights_dir, progress=say
                )
                report = write_report(matrix, folder)
                failed, reports[folder] = failed + matrix.failed, matrix
                say(f"{len(matrix.done)} cells done, {len(matrix.missing)} without a result\nreport: {report}")
    if source.is_dir():
        say(f"overview: {write_overview(reports, args.out)}")
    return 1 if failed else 0


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _folders(data: tuple[str, ...]) -> dict[str, Path]:
    folders = {}
    for item in data:
        name, separator, folder = item.partition("=")
        if not separator or not folder:
            raise input_error("--data", "NAME=FOLDER", f"{item!r}", "Name a sequence of the spec.")
        folders[name] = Path(folder).expanduser()
    return folders
