"""The GPU backend beside the CPU's and the reference, then its speed: one command, no network.

    python bench/gpu.py [--run RUN] [--wheel gsplat-*.whl] [--out FILE.json]

prints the machine, whether pictures and gradients agree, and milliseconds, as a Markdown page for docs/gpu.md; exit
status 1 if they do not agree. `--dry-run` does the same on the CPU, with the CPU backend in the GPU's place: it tests
this file, not a GPU. `--wheel` uses gsplat from a wheel that is not installed.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import common
import numpy as np
import rendering
import scenes
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from endoprior import render
from endoprior.model.deformation import HexPlaneField
from endoprior.model.scene import Scene, load_scene
from endoprior.presets import preset
from endoprior.render.constants import ALPHA_MAX
from endoprior.render.projection import FIELDS
from endoprior.types import Camera, Splats

SIZES = (common.Size(20_000, 640, 512), common.Size(40_000, 640, 512), common.Size(100_000, 640, 512))
SCENES, FRAMES = 20, 3
PICTURE_LIMIT, GRADIENT_LIMIT = 1e-3, 0.01
"""Largest difference of color, alpha and depth / largest depth; and of a gradient, relative to its norm."""
STRAY_PIXELS = {"random": 1e-4, "trained": 5e-4}
"""Share of pixels that may differ by more: where an edge hangs on the last bits, and, in a trained scene, where gsplat
1.5.3 lets alpha reach 0.999 (see render/cuda.py)."""
LARGEST_OPACITY = 0.985
"""Of random scenes: below where the two caps on alpha differ."""
LAPS, WARM_UP = 50, 5
MOMENT = 0.4
DRAWN = ("color", "alpha", "depth")


@dataclass(frozen=True)
class Contest:
    """Who is compared with whom, and where."""

    backend: render.Backend
    device: torch.device


@dataclass(frozen=True)
class Case:
    """One scene to agree on."""

    kind: str
    """`random` or `trained`."""
    name: str
    splats: Splats
    camera: Camera
    depth_grad_to_means: bool


@dataclass(frozen=True)
class Gap:
    """How far the backend is from another on one scene."""

    kind: str
    """`random` or `trained`."""
    scene: str
    against: str
    color: float
    """Largest difference of a channel."""
    alpha: float
    depth_mm: float
    depth: float
    """The same divided by the largest depth."""
    stray: float
    """Share of pixels in which any of color, alpha and depth differs by more than PICTURE_LIMIT."""
    gradient: float
    """Largest relative difference of a gradient, and"""
    worst: str
    """whose."""

    @property
    def agrees(self) -> bool:
        """Within the limits."""
        return self.stray <= STRAY_PIXELS[self.kind] and self.gradient <= GRADIENT_LIMIT


@dataclass(frozen=True)
class Lap:
    """One timing."""

    stage: str
    gaussians: int
    ms: float | None = None
    """Median; None if it could not be done."""
    memory_mb: float | None = None
    """Peak memory of the device, MB."""
    note: str = ""


def random_case(seed: int) -> Case:
    """150 Gaussians in and around a small picture, camera rotated and off-center; SH degree 0 to 3 in turn."""
    rng = np.random.default_rng(seed)
    width, height = int(rng.integers(40, 100)), int(rng.integers(40, 100))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix()
    pose[:3, 3] = rng.normal(size=3) * 5
    view = Camera(width, height, 1.1 * width, 1.3 * width, 0.45 * width, 0.6 * height, pose)
    num, degree = 150, seed % 4
    z = rng.uniform(30, 60, num)
    x = (rng.uniform(-0.3, 1.3, num) * width - view.cx) / view.fx * z
    y = (rng.uniform(-0.3, 1.3, num) * height - view.cy) / view.fy * z
    values = (
        (np.stack([x, y, z], -1) - pose[:3, 3]) @ pose[:3, :3],
        rng.normal(size=(num, 4)) * 2,
        np.exp(rng.uniform(np.log(0.2), np.log(6.0), (num, 3))) * (z / view.fx)[:, None],
        rng.uniform(0.01, LARGEST_OPACITY, num),
        rng.normal(size=(num, (degree + 1) ** 2, 3)) * 0.3,
    )
    splats = Splats(*(torch.tensor(v, dtype=torch.float32) for v in values))
    return Case("random", f"random {seed}", splats, view, seed % 2 == 0)


def trained_cases(run: Path) -> list[Case]:
    """A few frames of a trained scene."""
    scene, found = load_scene(run), []
    for index in np.linspace(0, len(scene.cameras) - 1, FRAMES).round().astype(int).tolist():
        splats = scene.at(index / len(scene.cameras))
        opaque = int((splats.opacities > ALPHA_MAX).sum())
        name = f"trained, frame {index}, {len(scene):,} Gaussians, {opaque:,} of opacity > {ALPHA_MAX}"
        found.append(Case("trained", name, splats, scene.cameras[index], scene.config.render.depth_grad_to_means))
    return found


def draw(backend: render.Backend, device: torch.device, case: Case) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Picture, and gradients under seeded random cotangents, as float64 on the CPU; the reference draws in float64."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {n: getattr(case.splats, n).detach().to(device, dtype).clone().requires_grad_() for n in FIELDS}
    background = torch.tensor([0.1, 0.2, 0.3], dtype=dtype, device=device)
    rasterize = render.load(backend)
    out = rasterize(Splats(**leaves), case.camera, background=background, depth_grad_to_means=case.depth_grad_to_means)
    out.means2d.retain_grad()
    generator = torch.Generator().manual_seed(0)
    pulled = background.new_zeros(())
    for name in DRAWN:
        image = getattr(out, name)
        pulled = pulled + (torch.randn(image.shape, generator=generator).to(image) * image).sum()
    pulled.backward()
    grads = {name: leaf.grad for name, leaf in leaves.items()} | {"means2d": out.means2d.grad}
    return on_cpu({name: getattr(out, name) for name in DRAWN}), on_cpu(grads)


def on_cpu(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same in float64 on the CPU."""
    return {name: tensor.detach().double().cpu() for name, tensor in tensors.items()}


def gap(contest: Contest, against: render.Backend, case: Case) -> Gap:
    """Compare the backend with another on one scene."""
    picture, grads = draw(contest.backend, contest.device, case)
    wanted, wanted_grads = draw(against, torch.device("cpu"), case)
    off = {name: numbers((picture[name] - wanted[name]).abs()) for name in DRAWN}
    off["color"] = off["color"].amax(-1)
    largest = wanted["depth"].max().clamp(min=1e-12)
    stray = (off["color"] > PICTURE_LIMIT) | (off["alpha"] > PICTURE_LIMIT) | (off["depth"] / largest > PICTURE_LIMIT)
    wanted_norms = {name: v.norm().clamp(min=1e-12) for name, v in wanted_grads.items()}
    relative = {name: float(numbers((grads[name] - wanted_grads[name]).norm() / v)) for name, v in wanted_norms.items()}
    worst = max(relative, key=relative.__getitem__)
    return Gap(
        kind=case.kind,
        scene=case.name,
        against=against,
        **{name: float(off[name].max()) for name in ("color", "alpha")},
        depth_mm=float(off["depth"].max()),
        depth=float(off["depth"].max() / largest),
        stray=float(stray.double().mean()),
        gradient=relative[worst],
        worst=worst,
    )


def numbers(values: Tensor) -> Tensor:
    """The same with infinity for NaN, which would pass every comparison unseen."""
    return values.nan_to_num(nan=math.inf)


def agreement(contest: Contest, num_scenes: int, run: Path | None) -> list[Gap]:
    """Random scenes against the CPU backend and the reference, frames of a trained one against the CPU backend."""
    cases = [random_case(seed) for seed in range(num_scenes)]
    found = [gap(contest, against, case) for case in cases for against in ("cpu", "reference")]
    return found + [gap(contest, "cpu", case) for case in (trained_cases(run) if run else [])]


def laps_ms(step: Callable[[], Any], device: torch.device, laps: int) -> float:
    """Median milliseconds of a step, measured on the device where it is a GPU."""
    for _ in range(min(WARM_UP, laps)):
        step()
    if device.type != "cuda":
        taken = []
        for _ in range(laps):
            began = time.perf_counter()
            step()
            taken.append(1e3 * (time.perf_counter() - began))
        return statistics.median(taken)
    events = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(laps)]
    torch.cuda.synchronize(device)
    for start, end in events:
        start.record()
        step()
        end.record()
    torch.cuda.synchronize(device)
    return statistics.median(start.elapsed_time(end) for start, end in events)


def speed(contest: Contest, sizes: tuple[common.Size, ...], laps: int) -> list[Lap]:
    """Drawing, drawing and its gradient, and drawing with either deformation before it."""
    found = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        on_device = Splats(**{name: getattr(splats, name).to(contest.device) for name in FIELDS})
        rasterize = partial(render.load(contest.backend), camera=camera, background=torch.zeros(3).to(contest.device))
        steps = {
            "drawn from kept splats": partial(drawn, rasterize, on_device),
            "drawn and differentiated": both_ways(rasterize, on_device),
        }
        for name in rendering.PRESETS:
            steps[f"deformed ({name}) and drawn"] = deformed(rasterize, name, splats, camera, contest.device)
        found += [timed(stage, size.num, step, contest.device, laps) for stage, step in steps.items()]
    return found


def timed(stage: str, num: int, step: Callable[[], Any], device: torch.device, laps: int) -> Lap:
    """One row; what the device cannot do yet is said in its note."""
    on_gpu = device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    try:
        ms = laps_ms(step, device, laps)
    except (AttributeError, NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        return Lap(stage, num, note=f"not possible: {str(error).splitlines()[0]:.120}")
    return Lap(stage, num, ms, torch.cuda.max_memory_allocated(device) / 1e6 if on_gpu else None)


@torch.no_grad()
def drawn(rasterize: Callable[..., Any], splats: Splats) -> None:
    """Forward only."""
    rasterize(splats)


def both_ways(rasterize: Callable[..., Any], splats: Splats) -> Callable[[], None]:
    """Forward, and backward to every input and to `means2d`, as training does."""
    leaves = Splats(**{name: getattr(splats, name).clone().requires_grad_() for name in FIELDS})

    def step() -> None:
        for name in FIELDS:
            getattr(leaves, name).grad = None
        out = rasterize(leaves, depth_grad_to_means=False)
        out.means2d.retain_grad()
        (out.color.square().mean() + 1e-4 * out.depth.mean()).backward()

    return step


def deformed(
    rasterize: Callable[..., Any], name: str, splats: Splats, camera: Camera, device: torch.device
) -> Callable[[], None]:
    """A preset's deformation at a moment, then forward, on the device; the first lap moves the scene there."""
    kept: list[Scene] = []

    def step() -> None:
        if not kept:
            cfg, field = preset(name).fitted(68), None
            if cfg.deformation.kind == "hexplane":
                field = HexPlaneField.from_points(splats.means, cfg.deformation, torch.Generator().manual_seed(0))
            scene = rendering.make_scene(splats, camera, cfg, field and field.to(device))
            kept.append(replace(scene, gaussians=scene.gaussians.to(device)))
        drawn(rasterize, kept[0].at(MOMENT))

    return step


def machine(contest: Contest) -> dict[str, str]:
    """What must be known to read the numbers."""
    found = {"commit": str(common.source_commit()), "torch": torch.__version__, "date": time.strftime("%Y-%m-%d")}
    if contest.device.type != "cuda":
        return found | {"GPU": "none: dry run on the CPU", "gsplat": "none: dry run on the CPU"}
    major, minor = torch.cuda.get_device_capability(contest.device)
    return found | {
        "GPU": f"{torch.cuda.get_device_name(contest.device)} (compute capability {major}.{minor})",
        "driver": driver(),
        "CUDA of torch": str(torch.version.cuda),
        "gsplat": str(getattr(import_module("gsplat"), "__version__", "unknown")),
    }


def driver() -> str:
    """Version of the GPU driver, as nvidia-smi says."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, check=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.splitlines()[0].strip() if answer.strip() else "unknown"


def page(facts: dict[str, str], first_ms: float, gaps: list[Gap], laps: list[Lap]) -> str:
    """Markdown for docs/gpu.md."""
    lines = ["| what | found |", "|---|---|", *(f"| {name} | {value} |" for name, value in facts.items())]
    lines += [f"| first picture, gsplat's build included | {first_ms / 1e3:.1f} s |", ""]
    lines += ["| scene | against | color | alpha | depth, mm | depth, relative | pixels beyond 1e-3 | gradient | |"]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    for g in summed(gaps):
        lines.append(
            f"| {g.scene} | {g.against} | {g.color:.1e} | {g.alpha:.1e} | {g.depth_mm:.1e} | {g.depth:.1e} "
            f"| {g.stray:.4%} | {g.gradient:.1e} ({g.worst}) | {'agrees' if g.agrees else 'DIFFERS'} |"
        )
    lines += ["", "| stage, 640x512 | Gaussians | ms | pictures/s | peak memory, MB |", "|---|---|---|---|---|"]
    for lap in laps:
        numbers = lap.note if lap.ms is None else f"{lap.ms:.3f} | {1e3 / lap.ms:,.0f}"
        memory = "" if lap.memory_mb is None else f"{lap.memory_mb:,.0f}"
        lines.append(f"| {lap.stage} | {lap.gaussians:,} | {numbers} | {memory} |" + (" |" if lap.ms is None else ""))
    return "\n".join(lines)


def summed(gaps: list[Gap]) -> list[Gap]:
    """One row for the random scenes against each other backend, the worst of every number; the others as they are."""
    rows = []
    for against in ("cpu", "reference"):
        if group := [g for g in gaps if g.kind == "random" and g.against == against]:
            worst = max(group, key=lambda g: g.gradient)
            most = {n: max(getattr(g, n) for g in group) for n in ("color", "alpha", "depth_mm", "depth", "stray")}
            rows.append(replace(worst, scene=f"random, worst of {len(group)}", **most))
    return rows + [g for g in gaps if g.kind != "random"]


def use_wheel(wheel: Path) -> None:
    """Unpack a wheel beside itself and import from there; gsplat builds its kernels from the sources in it, once."""
    folder = wheel.parent / wheel.stem
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    sys.path.insert(0, str(folder))


def main(arguments: list[str] | None = None) -> int:
    """Compare, time, print, write; 1 if the backends do not agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, metavar="RUN", help="a trained run folder, compared too")
    parser.add_argument("--wheel", type=Path, metavar="FILE", help="gsplat's wheel, if it is not installed")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write everything as JSON there")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, with the CPU backend in the GPU's place")
    parser.add_argument("--scenes", type=int, default=SCENES, help="random scenes (default %(default)s)")
    parser.add_argument("--gaussians", type=int, nargs="+", help="sizes to time (default 20000 40000 100000)")
    parser.add_argument("--laps", type=int, default=LAPS, help="of each timing (default %(default)s)")
    options = parser.parse_args(arguments)
    if options.wheel:
        use_wheel(options.wheel)
    contest = Contest("cpu", torch.device("cpu")) if options.dry_run else Contest("cuda", torch.device("cuda", 0))
    if not options.dry_run and not torch.cuda.is_available():
        print("expected a GPU that torch can use; found none. Try `endoprior doctor`, or --dry-run.", file=sys.stderr)
        return 2
    sizes = SIZES if not options.gaussians else tuple(common.Size(num, 640, 512) for num in options.gaussians)

    began = time.perf_counter()
    draw(contest.backend, contest.device, random_case(0))
    first_ms = 1e3 * (time.perf_counter() - began)
    facts = machine(contest)
    gaps = agreement(contest, options.scenes, options.run)
    laps = speed(contest, sizes, options.laps)
    print(page(facts, first_ms, gaps, laps))
    agrees = all(g.agrees for g in gaps)
    if options.out:
        parts = {"gaps": [asdict(g) | {"agrees": g.agrees} for g in gaps], "laps": [asdict(lap) for lap in laps]}
        options.out.write_text(json.dumps({"facts": facts, "first_ms": first_ms, **parts}, indent=2) + "\n", "utf-8")
    return 0 if agrees else 1


if __name__ == "__main__":
    sys.exit(main())
