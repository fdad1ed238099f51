"""The optional parts of the program and their packages, as `pyproject.toml` lists them."""

from __future__ import annotations

from functools import cache
from importlib.metadata import requires

from packaging.markers import Marker
from packaging.requirements import Requirement


@cache
def install_command(extra: str) -> str:
    """The command that installs the packages of an optional part: `pip install torchvision lpips`.

    It names the packages, because the program itself need not be on a package index.

    Args:
        extra: a name of `[project.optional-dependencies]`, `networks` for instance.
    """
    listed = [Requirement(line) for line in requires("endoprior") or ()]
    names = [each.name for each in listed if each.marker and _wants(each.marker, extra)]
    assert names, f"no optional part {extra}"
    return " ".join(["pip install", *names])


def _wants(marker: Marker, extra: str) -> bool:
    """Whether a requirement belongs to this extra, rather than to every installation on such a system."""
    return marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""})
