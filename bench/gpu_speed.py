"""How long a GPU backend takes to render, measured by the device's own clock."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import common
import scenes
import torch
from gpu_parity import Target

from endoprior import render
from endoprior.core.types import Camera, Splats
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.presets import preset
from endoprior.model.scene import SingleScene

SIZES = (common.Size(20_000, 640, 512), common.Size(40_000, 640, 512), common.Size(100_000, 640, 512))
PRESETS = ("default", "paper")
REPEATS, WARM_UP = 50, 5
TIME = 0.4
AT_A_TIME = 16
"""Images rendered in one call."""


@dataclass(frozen=True)
class Timing:
    backend: str
    stage: str
    gaussians: int
    ms: float | None = None
    """Median; None if it failed."""
    memory_mb: float | None = None
    """Peak memory of the device, MB."""
    note: str = ""
    images: int = 1
    """Rendered at a time."""


def median_ms(step: Callable[[], Any], device: torch.device, repeats: int) -> float:
    for _ in range(min(WARM_UP, repeats)):
        step()
    if device.type != "cuda":
        taken = []
        for _ in range(repeats):
            began = time.perf_counter()
            step()
            taken.append(1e3 * (time.perf_counter() - began))
        return statistics.median(taken)
    events = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(repeats)]
    torch.cuda.synchronize(device)
    for start, end in events:
        start.record()
        step()
        end.record()
    torch.cuda.synchronize(device)
    return statistics.median(start.elapsed_time(end) for start, end in events)


def speed(target: Target, sizes: tuple[common.Size, ...], repeats: int) -> list[Timing]:
    """Rendering, rendering with gradients, and rendering after either deformation."""
    found = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        on_device = Splats(**{name: value.to(target.device) for name, value in splats.tensors.items()})
        background = torch.zeros(3, device=target.device)
        rasterize = partial(render.load(target.backend), camera=camera, background=background)
        steps = {
            "rendered from cached splats": partial(forward, rasterize, on_device),
            "rendered, with gradients": both_ways(rasterize, on_device),
        }
        for name in PRESETS:
            steps[f"deformed ({name}) and rendered"] = deformed(rasterize, name, splats, camera, target.device)
        several = [on_device] * AT_A_TIME
        many = partial(render.load_many(target.backend), cameras=[camera] * AT_A_TIME, background=background)
        stage = f"rendered from cached splats, {AT_A_TIME} at a time"
        found.append(
            replace(timed(target, stage, size.num, partial(forward, many, several), repeats), images=AT_A_TIME)
        )
        found += [timed(target, stage, size.num, step, repeats) for stage, step in steps.items()]
    return found


def timed(target: Target, stage: str, num: int, step: Callable[[], Any], repeats: int) -> Timing:
    device = target.device
    on_gpu = device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    try:
        ms = median_ms(step, device, repeats)
    except (AttributeError, NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        return Timing(target.backend, stage, num, note=f"failed: {str(error).splitlines()[0]:.120}")
    return Timing(target.backend, stage, num, ms, torch.cuda.max_memory_allocated(device) / 1e6 if on_gpu else None)


@torch.no_grad()
def forward(rasterize: Callable[..., Any], splats: Splats | list[Splats]) -> None:
    rasterize(splats)


def both_ways(rasterize: Callable[..., Any], splats: Splats) -> Callable[[], None]:
    """Forward, and backward to every input and to `means2d`, as training does."""
    leaves = Splats(**{name: value.clone().requires_grad_() for name, value in splats.tensors.items()})

    def step() -> None:
        for leaf in leaves.tensors.values():
            leaf.grad = None
        out = rasterize(leaves, depth_grad_to_means=False)
        out.means2d.retain_grad()
        (out.color.square().mean() + 1e-4 * out.depth.mean()).backward()

    return step


def deformed(
    rasterize: Callable[..., Any], name: str, splats: Splats, camera: Camera, device: torch.device
) -> Callable[[], None]:
    """A preset's deformation at one time, then forward, on the device; the first call moves the scene there."""
    kept: list[SingleScene] = []

    def step() -> None:
        if not kept:
            cfg, field = preset(name).fitted(68), None
            if cfg.deformation.kind == "hexplane":
                field = HexPlaneField.from_points(splats.means, cfg.deformation, torch.Generator().manual_seed(0))
            scene = scenes.scene(splats, (camera,), cfg, field and field.to(device))
            kept.append(replace(scene, gaussians=scene.gaussians.to(device)))
        forward(rasterize, kept[0].at(TIME))

    return step
