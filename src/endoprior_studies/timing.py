"""How long a benchmark will take on this machine, and how much of the disk, from short trainings of its own methods.

One cell of each method and size of frames runs with the parts of its schedule cut to `MEASURED` iterations. The other
cells of the method take as long for an iteration, and as long beside the iterations for each frame. Gaussians do not
grow in so short a training, so that on an equally busy machine the time is a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from endoprior.core.config import Config
from endoprior.data.reading import read_own, read_parts
from endoprior.runs.folder import LOG, SCENE
from endoprior.runs.log import LOG_EVERY, read_log
from endoprior.system.atomic import write_json

from .matrix import Matrix, run_matrix
from .spec import Cell, Spec
from .worker import DONE, REPEAT

MEASURED = 3 * LOG_EVERY
"""Iterations of a part of the schedule; the first `LOG_EVERY` do not count."""
WORTH_IT = 5
"""A training that is not this many times as long as its measurement is not measured."""
NEVER = 10**6
SPEED = "speed.json"
"""In the folder of a measured cell."""
Parts = tuple[int, int, int, int]
"""Iterations: coarse, fine at half resolution, fine without and with the temporal term."""


def parts_of(cfg: Config) -> Parts:
    """The parts of a schedule whose iterations take differently long."""
    fine = cfg.schedule.fine_iterations
    half = min(cfg.schedule.half_resolution_iterations, fine)
    late = min(max(cfg.temporal.start_iteration, half), fine) if cfg.temporal.weight else fine
    return cfg.schedule.coarse_iterations, half, late - half, fine - late


def shortened(cfg: Config) -> dict[str, Any]:
    """Changes that cut each part to `MEASURED` iterations, with colors of the full degree and without growth."""
    coarse, half, plain, temporal = (min(part, MEASURED) for part in parts_of(cfg))
    return {
        "schedule.coarse_iterations": coarse,
        "schedule.fine_iterations": half + plain + temporal,
        "schedule.half_resolution_iterations": half,
        "schedule.sh_every": 1,
        "temporal.start_iteration": half + plain,
        "density.start_iteration": NEVER,
    }


@dataclass(frozen=True)
class Speed:
    """What one method costs on frames of one size."""

    iteration: tuple[float, ...]
    """Seconds of an iteration in each part."""
    windows: int
    """Trainings of a cell: a moving camera has several windows."""
    beside: float
    """Seconds of a cell for each frame beside iterations: reading, first Gaussians, scores."""
    size: int
    """Bytes that a cell keeps."""

    @staticmethod
    def of(folder: Path, parts: Parts, frames: int) -> Speed:
        """From the folder of a measured cell, whose scene is removed.

        Args:
            parts: of the measured schedule.
        """
        if (known := folder / SPEED).exists():
            return read_own(known, Speed, REPEAT)
        lines = read_log(folder / "run" / LOG, "stage", "iteration", "seconds")
        windows = 1 + max((line.get("window", 0) for line in lines), default=0)
        means, begins = [], (0, 0, parts[1], parts[1] + parts[2])
        for part, begin, stage in zip(parts, begins, ("coarse", "fine", "fine", "fine"), strict=True):
            inside = [
                line["seconds"]
                for line in lines
                if line["stage"] == stage and begin + LOG_EVERY < line["iteration"] <= begin + part
            ]
            means.append(sum(inside) / len(inside) if inside else 0.0)
        trained = windows * sum(part * mean for part, mean in zip(parts, means, strict=True))
        beside = max(read_parts(folder / DONE, {"seconds": float}, REPEAT)["seconds"] - trained, 0.0) / frames
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        speed = Speed(tuple(means), windows, beside, size)
        write_json(known, asdict(speed))
        for scene in folder.rglob(SCENE):
            scene.unlink()
        return speed

    def seconds(self, parts: Parts, frames: int) -> float:
        """Of a cell with such a schedule on so many frames."""
        return self.windows * sum(p * s for p, s in zip(parts, self.iteration, strict=True)) + frames * self.beside


@dataclass
class Estimate:
    """The time of the cells that are to be trained."""

    seconds: dict[str, dict[str, float]]
    """By name of the spec, then by folder of the cell; each folder is in one spec only."""
    size: int
    """Bytes that these cells keep."""
    unmeasured: int
    """Cells that are as short as a measurement, or have no schedule of ours."""

    def lines(self, at_once: int) -> list[str]:
        """What to tell the user, if so many cells run at a time."""
        hours = {name: sum(cells.values()) / at_once / 3600 for name, cells in self.seconds.items() if cells}
        longest = max((s for cells in self.seconds.values() for s in cells.values()), default=0.0) / 3600
        count = sum(map(len, self.seconds.values()))
        lines = []
        if count:
            each = ", ".join(f"{name} {value:.1f} h" for name, value in hours.items())
            total = max(sum(hours.values()), longest)
            lines.append(
                f"time on this machine: {total:.1f} h or more for {count} trainings, {at_once} at a time ({each})"
            )
            lines.append("measured on the machine as busy as it is now, and before Gaussians grow, which takes longer")
            lines.append(f"disk: about {self.size / 1e9:.1f} GB")
        if self.unmeasured:
            lines.append(f"{self.unmeasured} trainings are too short to be measured, or have no schedule that is known")
        return lines


Run = Callable[[Spec], Matrix]
"""Runs the cells of a spec."""


def estimate(specs: dict[str, Spec], out: Path, run: Run) -> Estimate:
    """Measure the methods of all specs, each once for each size of frames; measured ones are kept as other cells are.

    Args:
        specs: by the name that the estimate uses.
        out: folder of the benchmark, in which `run` writes.
    """
    found, speeds, seen = Estimate({}, 0, 0), dict[tuple[Any, ...], Speed | None](), set[str]()
    for title, spec in specs.items():
        looked = run_matrix(spec, out, None)
        waiting = {cell: folder for cell, folder in looked.waiting.items() if folder not in seen}
        seen.update(waiting.values())
        found.seconds[title] = {}
        for cell, folder in waiting.items():
            frames, *size = looked.extents[cell.sequence]
            key = (spec.methods[cell.method].name, *size)
            if key not in speeds:
                speeds[key] = _measured(spec, cell, run)
            if speed := speeds[key]:
                parts = parts_of(spec.config(cell.method, cell.sequence, cell.budget, cell.seed))
                found.seconds[title][folder] = speed.seconds(parts, frames)
                found.size += speed.size
            else:
                found.unmeasured += 1
    return found


def _measured(spec: Spec, cell: Cell, run: Run) -> Speed | None:
    """The speed of a cell; None if it is not worth it, cannot be measured or fails."""
    cfg = spec.config(cell.method, cell.sequence, cell.budget, cell.seed)
    if not isinstance(cfg, Config):
        return None
    changes = shortened(cfg)
    short = cfg.replace(changes)
    if cfg.schedule.total < WORTH_IT * short.schedule.total:
        return None
    method = replace(spec.methods[cell.method], set=spec.methods[cell.method].set | changes, match=None)
    alone = {"sequences": {cell.sequence: spec.sequences[cell.sequence]}, "methods": {cell.method: method}}
    probe = replace(spec, **alone, budgets=(), seeds=(cell.seed,), iterations=0, claims=(), protocols=())
    matrix = run(probe)
    folder = next(iter(matrix.done.values()), None)
    return Speed.of(folder, parts_of(short), matrix.extents[cell.sequence][0]) if folder else None
