"""Choose the device that trains or renders, by trying what is there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal

from ..core.checks import input_error
from ..core.config import Backend, Config
from ..system.console import say
from ..system.surroundings import python_command

if TYPE_CHECKING:
    from ..model.scene import RenderedScene

Wanted = Literal["auto", "cpu", "cuda"]
"""What `--device` takes."""
DEVICE_FILES = ("/dev/nvidia0", "/dev/nvidiactl", "/dev/nvhost-gpu", "/dev/dxg")
"""How programs on Linux reach a GPU: also in containers that have some of the GPUs, on a Jetson, in WSL."""
TRIAL_LIMIT_S = 120.0
"""Longest wait for a backend: importing torch, starting the GPU and compiling Triton's or Numba's kernels, once."""
COMPILE_LIMIT_S = 3600.0


@dataclass(frozen=True)
class Trial:
    """What came of rendering with a backend."""

    works: bool
    found: str
    """One line: the device and how well it agrees with `reference`, or what failed in its own words."""
    printed: str = ""
    """All that it printed."""


@dataclass(frozen=True)
class DeviceChoice:
    """A device, the backend that renders on it, and why it was chosen."""

    device: Literal["cpu", "cuda"]
    backend: Backend
    why: str
    """One line for the user: "CPU: torch 2.13.0+cpu, built without CUDA"."""


def why_no_gpu() -> str:
    """Why no backend can run on a GPU here; "" if one may. In milliseconds where there is no GPU."""
    if sys.platform == "darwin" or (sys.platform == "linux" and not any(map(os.path.exists, DEVICE_FILES))):
        return "no NVIDIA GPU found"
    import torch

    return "" if torch.version.cuda else f"torch {torch.__version__}, built without CUDA"


@cache
def try_backend(backend: Backend, *, compiles: bool = False) -> Trial:
    """Render with a backend in a process of its own: it may crash, hang, print anything, and compile gsplat first."""
    limit_s = COMPILE_LIMIT_S if compiles else TRIAL_LIMIT_S
    words = python_command("endoprior.render.trial", backend, *["compile"] * compiles)
    status = None
    with tempfile.TemporaryFile() as output:  # no pipe: what the process starts could keep one open
        process = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            with suppress(subprocess.TimeoutExpired):
                status = process.wait(limit_s)
        finally:  # also after Ctrl-C
            _end(process)
        output.seek(0)
        printed = output.read().decode("utf-8", "replace").strip()
    found = (printed.splitlines() or ["no answer"])[-1]
    if status is None or status < 0:
        found = f"no answer in {limit_s:g} s" if status is None else f"ended by signal {-status}"
    return Trial(status == 0, found, printed)


def _end(process: subprocess.Popen) -> None:
    """End the process and, where that is possible, all that it started; a driver that hangs may keep it."""
    with suppress(OSError):  # all gone
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    with suppress(subprocess.TimeoutExpired):
        process.wait(1.0)


@cache
def choose(wanted: Wanted) -> DeviceChoice:
    """The device and the backend: gsplat where it works and is compiled, else Triton where that works, else the CPU.

    InputError if "cuda" is wanted and no backend works on it.
    """
    if wanted == "cpu":
        return DeviceChoice("cpu", "numba", "CPU: as requested")
    if not (problem := why_no_gpu()):
        from ..render import ON_GPU

        failed = []
        for backend in ON_GPU:
            trial = try_backend(backend) if find_spec(backend) else Trial(False, "not installed")
            if trial.works:
                return DeviceChoice("cuda", backend, f"CUDA: {trial.found.partition(';')[0]}")
            failed.append(f"{backend}: {trial.found}")
        problem = "; ".join(failed)
    if wanted == "cuda":
        fix = "`endoprior doctor` and docs/gpu.md tell more."
        raise input_error("--device cuda", "a GPU that renders", problem, fix)
    return DeviceChoice("cpu", "numba", f"CPU: {problem}")


def on_device(scene: RenderedScene, wanted: Wanted, *, fp16_planes: bool = False) -> RenderedScene:
    """The scene on the chosen device. Prints the device and the reason, unless the user asked for the CPU.

    Args:
        fp16_planes: on a GPU, store a HexPlane as fp16 (`Scene.to`): for viewing, not for scores.
    """
    choice = choose(wanted)
    if wanted != "cpu":
        say(choice.why)
    on_gpu = choice.device != "cpu"
    return scene.to(choice.device, backend=choice.backend if on_gpu else None, fp16_planes=fp16_planes and on_gpu)


def with_device(cfg: Config, wanted: Wanted, tell: Callable[[str], None] = say) -> Config:
    """The config with the rendering backend of the chosen device; `tell` takes the device and the reason."""
    from ..render import ON_GPU

    if cfg.render.backend in ON_GPU:
        option = f"--render.backend {cfg.render.backend}"
        if wanted == "cpu":
            raise input_error(option, "--device cuda or auto", "cpu", f"Remove --device cpu or {option}.")
        if problem := why_no_gpu():
            raise input_error(option, "a GPU that torch can use", problem, "leave it out for the CPU.")
        tell(f"CUDA: {cfg.render.backend}, as requested")  # which may compile itself first
        return cfg
    choice = choose(wanted)
    tell(choice.why)
    return cfg if choice.device == "cpu" else replace(cfg, render=replace(cfg.render, backend=choice.backend))
