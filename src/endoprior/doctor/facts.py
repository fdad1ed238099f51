"""Reading the facts of this machine. Each is read on its own: one that fails or hangs does not affect the others."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import re
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from ..system.memory import available_bytes
from ..system.own_python import python_command
from .driver import driver_answers, driver_files
from .probe_process import MARK, Answer, clean, run_program
from .records import Builders, Driver, Facts, Gpu, Gsplat, System, Toolkit, Torch, Triton
from .toolchain import find_builders, find_toolkit

TORCH_LIMIT_S = 90.0
"""Longest wait for torch, s: a first import from a slow disk, and a context on each of many GPUs, take time."""
LOAD_LIMIT_S = 60.0
COMPILE_LIMIT_S = 3600.0
PACKAGES = ("OpenEXR", "transformers", "torchvision", "lpips", "pycolmap", "ray")
"""What optional parts import."""
VARIABLES = (
    "CUDA_HOME", "CUDA_PATH", "CUDA_VISIBLE_DEVICES", "CUDA_INC_PATH", "TORCH_CUDA_ARCH_LIST", "TORCH_EXTENSIONS_DIR",
    "MAX_JOBS", "CC", "CXX", "TRITON_INTERPRET", "TRITON_CACHE_DIR", "TRITON_LIBCUDA_PATH", "OMP_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)  # fmt: skip
"""Shown when set, besides our own: they change what is found, or how fast it is."""
PACKAGE_MANAGERS = ("apt-get", "dnf", "zypper", "pacman")

T = TypeVar("T")
TorchFacts = tuple[Torch, Triton, dict[str, str], str]
"""Torch, Triton, the weights that were found, and the error if there was one."""


def read_facts_quickly() -> Facts:
    """What needs no other program, in milliseconds: enough to know that there is no CUDA here."""
    return Facts(system=_or(System(), _system), driver=_or(Driver(), driver_files), torch=_or(Torch(), _torch_files))


def read_facts(torch_limit_s: float = TORCH_LIMIT_S) -> Facts:
    """Everything, in the time of one import of torch; never raises.

    Args:
        torch_limit_s: longest wait for torch.
    """
    known = read_facts_quickly()
    with ThreadPoolExecutor(3) as pool:
        driver = pool.submit(_or, known.driver, driver_answers, known.driver)
        toolkit = pool.submit(_or, Toolkit(), find_toolkit)
        builders = pool.submit(_or, Builders(), find_builders)
        # Torch takes longest and runs in this thread, so that Ctrl-C ends it at once.
        without: TorchFacts = (known.torch, Triton(), {}, "the probe of torch failed")
        torch, triton, weights, weights_error = _or(without, _probe_torch, torch_limit_s)
        return replace(
            known,
            torch=torch,
            triton=triton,
            driver=driver.result(),
            toolkit=toolkit.result(),
            builders=builders.result(),
            gsplat=_or(Gsplat(), read_gsplat, torch),
            packages={name: _package(name) for name in PACKAGES},
            weights=weights,
            weights_error=weights_error,
            variables=_variables(),
        )


def compile_gsplat(facts: Facts, limit_s: float = COMPILE_LIMIT_S) -> Facts:
    """Compile gsplat, which takes minutes, and render with it; the facts with the result."""
    answer = _run("gsplat_probe", ["compile"], limit_s)
    found = _after(answer)
    gsplat = _or(facts.gsplat, _gsplat_files, facts.torch)
    if found is None:
        error = f"{answer.problem} {clean(answer.text[-300:])}"
        return replace(facts, gsplat=replace(gsplat, loads=False, error=error))
    seconds = found.get("seconds")
    loads, error = found.get("loads") is True, clean(str(found.get("error", "")), 600)
    kept = seconds if isinstance(seconds, int | float) else None
    return replace(facts, gsplat=replace(gsplat, loads=loads, error=error, compile_seconds=kept))


def _or(otherwise: T, read: Callable[..., T], *arguments: Any) -> T:
    """What `read` returns, or `otherwise` if it raises anything."""
    try:
        return read(*arguments)
    except Exception:
        return otherwise


def _system() -> System:
    free = available_bytes()
    return System(
        name=platform.system(),
        release=_release(),
        machine=platform.machine(),
        python=platform.python_version(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        free_gb=None if free is None else free / 1e9,
        container=any(Path(file).exists() for file in ("/.dockerenv", "/run/.containerenv", "/.singularity.d")),
        packages=next((name for name in PACKAGE_MANAGERS if shutil.which(name)), ""),
    )


def _release() -> str:
    try:
        return clean(platform.freedesktop_os_release().get("PRETTY_NAME", ""), 60)
    except (OSError, AttributeError):
        return clean(platform.release(), 60)


def _torch_files() -> Torch:
    """Version and build of torch from its files: importing it takes seconds."""
    spec = importlib.util.find_spec("torch")
    if spec is None or not spec.submodule_search_locations:
        return Torch()
    text = (Path(next(iter(spec.submodule_search_locations))) / "version.py").read_text(encoding="utf-8")

    def value(name: str) -> str:
        found = re.search(rf"^{name}\b[^=\n]*=\s*['\"]([^'\"\n]*)['\"]", text, re.MULTILINE)
        return clean(found[1], 40) if found else ""

    return Torch(version=value("__version__"), cuda=value("cuda"), hip=value("hip"))


def _probe_torch(limit_s: float) -> TorchFacts:
    """What a process that imports torch finds."""
    installed = _or(Torch(), _torch_files)
    answer = _run("torch_probe", [], limit_s)
    found = _after(answer)
    if found is None:
        reason = f"{answer.problem or 'no answer'} {clean(answer.text[-160:])}".strip()
        torch = replace(installed, error=reason) if installed.version else installed
        return torch, Triton(), {}, "torch gave no answer"
    if not installed.version and "version" not in found:
        return installed, Triton(), {}, "torch is not installed"
    texts = {name: clean(str(found.get(name, ""))) for name in ("error", "reason", "extensions")}
    torch = Torch(
        version=str(found.get("version", installed.version)),
        cuda=str(found.get("cuda", installed.cuda)),
        hip=str(found.get("hip", installed.hip)),
        available=found.get("available"),
        gpus=tuple(_gpu(entry) for entry in found.get("gpus", ())),
        host_compilers=found.get("host_compilers", {}),
        **texts,
    )
    triton = _or(Triton(), _triton, torch, found.get("triton", {}), answer)
    return torch, triton, found.get("weights", {}), clean(str(found.get("weights_error", "")))


def _triton(torch: Torch, found: Mapping[str, Any], answer: Answer) -> Triton:
    """Triton, from the probe of torch: if that ended while it tried Triton, Triton is what failed."""
    version, computes = clean(str(found.get("version", "")), 40), found.get("computes")
    error = clean(str(found.get("error", "")))
    if version and computes is None and torch.gpus and torch.gpus[0].computes:
        computes, error = False, answer.problem or "no answer"
    elif computes is False:  # Triton only tells the status of the C compiler, which printed its reason
        printed = [line for line in answer.text.splitlines() if "error: " in line and not line.startswith(MARK)]
        error = clean(printed[0]) if printed else error
    return Triton(version, _or("", _triton_wanted), computes, error)


def _triton_wanted() -> str:
    """The Triton that torch was built with, as a requirement for pip: torch names it, older ones in brackets."""
    for requirement in metadata.requires("torch") or ():
        if found := re.match(r"triton\s*\(?\s*([=<>!~][^;)\s]*)", requirement):
            return f"triton{found[1]}"
    return ""


def _gpu(entry: Mapping[str, Any]) -> Gpu:
    known = {field.name for field in fields(Gpu)}
    values = {name: value for name, value in entry.items() if name in known}
    if capability := values.get("capability"):
        values["capability"] = (int(capability[0]), int(capability[1]))
    return Gpu(**values | {"error": clean(str(values.get("error", "")))})


def read_gsplat(torch: Torch, limit_s: float = LOAD_LIMIT_S) -> Gsplat:
    """Version, compiled files, and whether they load; gsplat is not imported and nothing is compiled.

    Args:
        torch: its `extensions` is the folder of what torch compiled; without CUDA nothing is loaded.
        limit_s: longest wait for each file to load.
    """
    gsplat = _gsplat_files(torch)
    name, file = ("csrc", gsplat.prebuilt) if gsplat.prebuilt else ("gsplat_cuda", gsplat.cached)
    if not file or not torch.cuda or torch.error:
        return gsplat
    gsplat = _tried(gsplat, name, file, limit_s)
    if not gsplat.loads and gsplat.prebuilt and gsplat.cached:  # gsplat, too, then takes its own compiled code
        gsplat = _tried(replace(gsplat, prebuilt=""), "gsplat_cuda", gsplat.cached, limit_s)
    return gsplat


def _tried(gsplat: Gsplat, name: str, file: str, limit_s: float) -> Gsplat:
    answer = _run("gsplat_probe", ["load", name, file], limit_s)
    found = _after(answer) or {"error": answer.problem}
    return replace(gsplat, loads=found.get("loads") is True, error=clean(str(found.get("error", ""))))


def _gsplat_files(torch: Torch) -> Gsplat:
    """Where gsplat and its compiled code are, by their files: importing it could compile."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or not spec.submodule_search_locations:
        return Gsplat()
    package = Path(next(iter(spec.submodule_search_locations)))
    ending = "pyd" if os.name == "nt" else "so"
    built = Path(torch.extensions) / "gsplat_cuda" / f"gsplat_cuda.{ending}" if torch.extensions else None
    return Gsplat(
        version=_package("gsplat") or "?",
        prebuilt=next((str(file) for file in sorted(package.glob(f"csrc*.{ending}"))), ""),
        cached=str(built) if built and built.is_file() else "",
        compiled_by=_or("", _compiled_by, built.parent) if built else "",
        current=_or(None, _current, built.parent) if built else None,
    )


def _compiled_by(folder: Path) -> str:
    """The nvcc in the file that torch wrote for ninja, "" if there is none."""
    text = (folder / "build.ninja").read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^nvcc = (\S+)$", text, re.MULTILINE)
    return found[1] if found else ""


def _current(folder: Path) -> bool | None:
    """Whether ninja would compile nothing there: another ninja, or sources that changed, have it compile all."""
    if not (folder / "build.ninja").is_file():
        return None
    answer = run_program(["ninja", "-C", str(folder), "-n"], LOAD_LIMIT_S)  # -n: a dry run
    return None if answer.problem else "no work to do" in answer.text


def _package(name: str) -> str:
    """Version of an installed package, "" if it is not there; nothing is imported."""
    try:
        if importlib.util.find_spec(name) is None:
            return ""
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "?"
    except (ImportError, ValueError):
        return ""


def _variables() -> dict[str, str]:
    ours = sorted(name for name in os.environ if name.startswith("ENDOPRIOR_"))
    return {clean(name, 60): clean(os.environ[name], 120) for name in (*ours, *VARIABLES) if name in os.environ}


def _run(module: str, arguments: list[str], limit_s: float) -> Answer:
    return run_program(python_command(f"{__package__}.{module}", *arguments), limit_s)


def _after(answer: Answer) -> dict[str, Any] | None:
    """The JSON object after the last `MARK` in what a probe printed, whatever else was printed around it."""
    for line in reversed(answer.text.splitlines()):
        if line.startswith(MARK):
            try:
                found = json.loads(line.removeprefix(MARK))
            except ValueError:
                return None
            return found if isinstance(found, dict) else None
    return None
