"""`endoprior doctor` and `endoprior plugins`: what is installed, and what of it works."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from ..core.checks import InputError
from ..core.config import Backend
from ..core.shell import install_command, packages_of
from ..system.console import say
from ..system.devices import num_cores
from ..system.installation import docs_folder, page, source_commit
from ..system.memory import available_bytes
from ..system.plugins import OWN_PACKAGE, installed
from .arguments import Command
from .devices import choose, try_backend, why_no_gpu

NEEDED = ("torch", "numba", "numpy")
OPTIONAL = {
    "exr": "depth in OpenEXR files",
    "mono": "depth by a network",
    "networks": "network scores",
    "poses": "camera path by COLMAP",
    "ray": "trainings on a cluster",
    "tensorboard": "curves of a training in TensorBoard",
    "tools": "tool masks by SAM 2",
    "usd": "OpenUSD files",
}
"""Optional part of the installation -> what it is for."""


@dataclass
class Doctor(Command):
    """Report versions and optional parts, and render a small scene with each backend that could work here."""

    compile: bool = False
    """Compile gsplat now, which takes minutes, and render with it. Without a GPU, as in a container build, it compiles
    for the architectures in TORCH_CUDA_ARCH_LIST. Exit status 1 if that fails."""

    examples = ("", "--compile")

    def execute(self) -> int:
        """Print the report. Exit status 1 if the CPU cannot render or --compile fails, whatever else is missing."""
        say(
            f"endoprior {version('endoprior')}, commit {source_commit() or 'unknown'}; documentation: {docs_folder()}\n"
        )
        free = available_bytes()
        memory = "unknown memory" if free is None else f"{free / 1e9:.1f} GB free"
        _row("computer", f"{platform.platform(terse=True)}, {platform.machine()}, {num_cores()} cores, {memory}")
        _row("Python", platform.python_version())
        for name in NEEDED:
            _row(name, _version(name) or "not installed")
        for part, purpose in OPTIONAL.items():
            versions = {name: _version(name) for name in packages_of(part)}
            there = ", ".join(f"{name} {found}" for name, found in versions.items())
            _row(part, f"{purpose}: {there if versions and all(versions.values()) else install_command(part)}")
        say("")
        works = {"numba": _try("numba")}
        if self.compile:
            say("compiling gsplat; this takes minutes")
            works["gsplat"] = _try("gsplat", compiles=True)
        if problem := why_no_gpu():
            _row("GPU", f"{problem}; everything runs on the CPU")
        else:
            for backend in ("triton", "gsplat"):
                if backend not in works:
                    _try(backend)
        say(f"\n--device auto: {choose('auto').why}")
        if not works["numba"]:
            say(f"This computer cannot train yet: {page('install.md')}")
        elif not works.get("gsplat", True) or choose("auto").device == "cpu":
            say(f"What a GPU needs: {page('gpu.md')}")
        return 0 if all(works.values()) else 1


def _row(name: str, found: str) -> None:
    say(f"{name:<10}{found}")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _try(backend: Backend, *, compiles: bool = False) -> bool:
    """Try a backend and print what came of it; whether it works."""
    trial = try_backend(backend, compiles=compiles)
    _row(backend, f"{'works' if trial.works else 'fails'}: {trial.found}")
    if not trial.works:
        for line in trial.printed.splitlines()[-12:-1]:
            _row("", f"| {line}")
    return trial.works


@dataclass
class Plugins(Command):
    """List datasets, methods, scores, ...: what is built in, and what other packages add (docs/plugins.md)."""

    examples = ("",)

    def execute(self) -> None:
        """Import every plugin and print one line for each."""
        from ..data.formats import REGISTRY as DATASETS
        from ..evaluation.protocols.table import PROTOCOLS
        from ..evaluation.registry import REGISTRY as SCORES
        from ..export.formats import REGISTRY as EXPORTERS
        from ..model.method import METHODS
        from ..model.presets import PRESETS
        from . import REGISTRY as COMMANDS

        _say_row("kind", "name", "package")
        for registry in (DATASETS, METHODS, PRESETS, SCORES, PROTOCOLS, EXPORTERS, COMMANDS):
            for name in registry.builtin:
                _say_row(registry.kind, name, "built in")
            for plugin in installed(registry.kind):
                if plugin.package != OWN_PACKAGE:
                    try:
                        registry.loaded(plugin)
                        _say_row(registry.kind, plugin.name, plugin.origin)
                    except InputError as error:
                        _say_row(registry.kind, plugin.name, plugin.origin, f"error: {error}")


def _say_row(kind: str, name: str, package: str, error: str = "") -> None:
    say(f"{kind:<11}{name:<20}{package:<28}{error}".rstrip())
