"""The optional parts of the program and their packages, as `pyproject.toml` lists them."""

from __future__ import annotations

from functools import cache
from importlib.metadata import requires

from packaging.markers import Marker
from packaging.requirements import Requirement


@cache
def install_command(extra: str) -> str:
    """The command that installs the packages of an optional part: `pip install -c constraints.txt torchvision lpips`.

    It names the packages, because the program itself need not be on a package index. The constraints keep torch as it
    is; gsplat is installed without them, because it fits every torch and a GPU may need another version than theirs.

    Args:
        extra: a name of `[project.optional-dependencies]`, `networks` for instance.
    """
    names = packages_of(extra)
    if not names:  # the installation is older than the program: a checkout that was updated since
        return f"pip install -c constraints.txt '.[{extra}]'"
    return " ".join(["pip install", *([] if extra == "cuda" else ["-c constraints.txt"]), *names])


def packages_of(extra: str) -> list[str]:
    """The packages of an optional part, as the installation lists them."""
    listed = [Requirement(line) for line in requires("endoprior") or ()]
    return [each.name for each in listed if each.marker and _wants(each.marker, extra)]


def missing_package(package: str, extra: str, error: ImportError) -> str:
    """One sentence about a package of an optional part that is not installed or cannot be imported, and the fix."""
    is_absent = isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] == package
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    state = "is not installed" if is_absent else f"cannot be imported ({reason})"
    return f"{package} {state}. Fix: `{install_command(extra)}`."


def _wants(marker: Marker, extra: str) -> bool:
    """Whether a requirement belongs to this extra, rather than to every installation on such a system."""
    return marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""})
